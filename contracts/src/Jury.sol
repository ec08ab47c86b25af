// SPDX-License-Identifier: Apache-2.0
pragma solidity ^0.8.28;

import {IValidator} from "./IValidator.sol";
import {Signatures} from "./Signatures.sol";
import {XRT} from "./XRT.sol";

/// @title A validator of generation 5: results count that a quorum of its jurors has signed.
/// @notice Parties name it in demand and offer. Each juror examines the promisor's result and signs the same message, with
/// `success` as the juror sees it. Jurors and quorum can't change, so the parties know who will judge. Any contract that
/// answers `isValidator` can be a validator, but it needs a way to pay its fees out.
contract Jury is IValidator {
    /// @notice The most jurors: with 7 there are at most 35 sets of a quorum's size to look through.
    uint256 public constant MOST_JURORS = 7;

    /// @notice Who receives the fees.
    address public immutable keeper;
    /// @notice The token in which validators are paid.
    XRT public immutable xrt;
    /// @notice How many jurors must sign the same result.
    uint256 public immutable quorum;

    /// Immutables, as reading them takes next to no gas; zero where there are fewer jurors.
    uint256 private immutable _count;
    address private immutable _juror0;
    address private immutable _juror1;
    address private immutable _juror2;
    address private immutable _juror3;
    address private immutable _juror4;
    address private immutable _juror5;
    address private immutable _juror6;

    error NotTheKeeper(address caller);
    /// There are 1 to MOST_JURORS jurors.
    error InvalidJurorCount(uint256 jurors, uint256 most);
    /// The quorum is 1 to the number of jurors.
    error InvalidQuorum(uint256 quorum, uint256 jurors);
    /// Jurors are given in strictly ascending order, without the zero address.
    error JurorsOutOfOrder(address previous, address next);

    /// @notice The deployer is the keeper.
    /// @param jurors_ 1 to 7 accounts in strictly ascending order.
    /// @param quorum_ how many of them must sign the same result.
    constructor(XRT xrt_, address[] memory jurors_, uint256 quorum_) {
        uint256 count = jurors_.length;
        if (count == 0 || count > MOST_JURORS) revert InvalidJurorCount(count, MOST_JURORS);
        if (quorum_ == 0 || quorum_ > count) revert InvalidQuorum(quorum_, count);
        address previous = address(0);
        for (uint256 i = 0; i < count; ++i) {
            if (jurors_[i] <= previous) revert JurorsOutOfOrder(previous, jurors_[i]);
            previous = jurors_[i];
        }
        (keeper, xrt, quorum, _count) = (msg.sender, xrt_, quorum_, count);
        _juror0 = jurors_[0];
        _juror1 = count > 1 ? jurors_[1] : address(0);
        _juror2 = count > 2 ? jurors_[2] : address(0);
        _juror3 = count > 3 ? jurors_[3] : address(0);
        _juror4 = count > 4 ? jurors_[4] : address(0);
        _juror5 = count > 5 ? jurors_[5] : address(0);
        _juror6 = count > 6 ? jurors_[6] : address(0);
    }

    /// @notice Pays fees out to the keeper.
    /// @param value wn.
    function collect(uint256 value) external {
        if (msg.sender != keeper) revert NotTheKeeper(msg.sender);
        // slither-disable-next-line unchecked-transfer (XRT returns true or reverts)
        xrt.transfer(keeper, value);
    }

    /// @inheritdoc IValidator
    /// @param signer a juror, if one is a quorum; otherwise the address that stands for as many jurors as are a quorum
    /// (see Signatures).
    function isValidator(address signer) external view returns (bool) {
        address[] memory all = jurors();
        if (quorum > 1) return _isQuorum(signer, all);
        for (uint256 i = 0; i < all.length; ++i) {
            if (all[i] == signer) return true;
        }
        return false;
    }

    /// @notice Who judges, in ascending order.
    function jurors() public view returns (address[] memory all) {
        all = new address[](MOST_JURORS);
        (all[0], all[1], all[2], all[3]) = (_juror0, _juror1, _juror2, _juror3);
        (all[4], all[5], all[6]) = (_juror4, _juror5, _juror6);
        uint256 count = _count;
        assembly ("memory-safe") {
            mstore(all, count)
        }
    }

    /// Whether `signer` stands for any quorum of all jurors.
    function _isQuorum(address signer, address[] memory all) private view returns (bool) {
        address[] memory chosen = new address[](quorum);
        uint256 choices = all.length - chosen.length;
        uint256 first;
        uint256 place;
        assembly ("memory-safe") {
            first := add(all, 0x20)
            place := add(chosen, 0x20)
        }
        return _completes(signer, chosen, place, place + 32 * (chosen.length - 1), first, first + 32 * choices);
    }

    /// Whether `signer` stands for the jurors that are chosen in the places before `place`, and some more. The positions
    /// are those of words in memory, as bounds that are checked for each word would cost as much as all signatures.
    /// @param next the first juror who may take this place, and `last` the last one.
    function _completes(
        address signer,
        address[] memory chosen,
        uint256 place,
        uint256 lastPlace,
        uint256 next,
        uint256 last
    ) private pure returns (bool) {
        unchecked {
            for (; next <= last; next += 32) {
                assembly ("memory-safe") {
                    mstore(place, mload(next))
                }
                if (place == lastPlace) {
                    if (Signatures.standIn(chosen) == signer) return true;
                } else if (_completes(signer, chosen, place + 32, lastPlace, next + 32, last + 32)) {
                    return true;
                }
            }
        }
        return false;
    }
}
