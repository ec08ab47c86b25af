// SPDX-License-Identifier: Apache-2.0
pragma solidity ^0.8.28;

import {Clone} from "./Clone.sol";
import {RobonomicsErrors} from "./Errors.sol";
import {Liability} from "./Liability.sol";
import {Turns} from "./Turns.sol";
import {XRT} from "./XRT.sol";

/// @notice What a lighthouse asks of the factory.
interface ILighthouseFactory {
    function finalizeLiability(address liability, bytes calldata result, bool success, bytes calldata signature)
        external;
}

/// @title A lighthouse: providers who stake XRT and in turn send the network's transactions.
/// @notice This is the implementation behind the clones; a clone's minimal stake, timeout and name are in its code.
// slither-disable-next-line missing-inheritance (its finalizeLiability is the network's, which returns a bool)
contract Lighthouse is RobonomicsErrors, Turns {
    /// @notice The factory that made this lighthouse.
    address public immutable factory;
    /// @notice The token of the stakes.
    XRT public immutable xrt;

    /// @dev Made by the factory's constructor.
    constructor(XRT xrt_) {
        factory = msg.sender;
        xrt = xrt_;
    }

    /// @notice Makes a liability of a demand and an offer that match, on the provider's turn.
    /// @dev The arguments go to the factory as they came: canonical ABI encodings of the promisee's order and the
    /// promisor's.
    function createLiability(bytes calldata, bytes calldata) external returns (bool) {
        _useTurn();
        _callFactory(abi.encodePacked(msg.data, msg.sender));
        return true;
    }

    /// @notice As `createLiability`, with the promisee's permit (EIP-2612) for the factory: the promisee needs no
    /// transaction, and pays the provider the fee in the demand, see `Factory.createLiabilityWithPermit`.
    function createLiabilityWithPermit(bytes calldata, bytes calldata, uint256, uint256, uint8, bytes32, bytes32)
        external
        returns (bool)
    {
        _useTurn();
        _callFactory(abi.encodePacked(msg.data, msg.sender));
        return true;
    }

    /// @notice Ends a liability of this lighthouse with a signed result, on the provider's turn.
    /// @dev The arguments go to the factory as they came: liability, 34-byte multihash of the result, success and the
    /// signature of the promisor or, in generation 5, the signatures of those whom the validator accepts.
    function finalizeLiability(address, bytes calldata, bool, bytes calldata) external returns (bool) {
        _useTurn();
        _callFactory(abi.encodePacked(msg.data, msg.sender));
        return true;
    }

    /// @notice Generation 3's way to end a liability.
    /// @param data canonical calldata of `finalize(bytes result, bool success, bytes signature, bool agree)`; `agree`
    /// is a validator's word and of no meaning here.
    function to(address liability, bytes calldata data) external returns (bool) {
        if (bytes4(data) != Liability.finalize.selector) revert OnlyFinalize();
        (bytes calldata result, bool success, bytes calldata signature) = _readFinalize(data[4:]);
        _useTurn();
        bytes memory call =
            abi.encodeCall(ILighthouseFactory.finalizeLiability, (liability, result, success, signature));
        _callFactory(abi.encodePacked(call, msg.sender));
        return true;
    }

    /// @notice Adds to the caller's stake; the first time it makes the caller a provider.
    /// @param value wn, approved for this lighthouse.
    function refill(uint256 value) external returns (bool) {
        _setStake(msg.sender, stakes[msg.sender] + value);
        // slither-disable-next-line unchecked-transfer (XRT returns true or reverts)
        xrt.transferFrom(msg.sender, address(this), value);
        return true;
    }

    /// @notice Takes from the caller's stake; what is left below the minimal stake is paid out too and the caller
    /// leaves.
    /// @param value wn.
    function withdraw(uint256 value) external returns (bool) {
        if (indexOf(msg.sender) == 0) revert NotAProvider(msg.sender);
        uint256 stake = stakes[msg.sender];
        if (value > stake) revert InsufficientStake(stake, value);
        if (stake - value < minimalStake()) {
            value = stake;
            _leave(msg.sender);
        } else {
            _setStake(msg.sender, stake - value);
        }
        // slither-disable-next-line unchecked-transfer (XRT returns true or reverts)
        xrt.transfer(msg.sender, value);
        return true;
    }

    /// @notice The label of the lighthouse's ENS names.
    function name() external view returns (string memory) {
        bytes memory code = address(this).code;
        uint256 start = Clone.ARGUMENTS + 20;
        bytes memory label = new bytes(code.length - start);
        for (uint256 i = 0; i < label.length; ++i) label[i] = code[start + i];
        return string(label);
    }

    /// @notice Generation 3's name of `providers`.
    function members(uint256 index) external view returns (address) {
        return providers(index);
    }

    /// @notice Generation 3's name of `providersLength`.
    function membersLength() external view returns (uint256) {
        return providersLength();
    }

    /// @notice Generation 3's name of `stakes`.
    function balances(address provider) external view returns (uint256) {
        return stakes[provider];
    }

    /// @notice Generation 3's name of `minimalStake`.
    function minimalFreeze() external view returns (uint256) {
        return minimalStake();
    }

    /// @notice Generation 3's name of `timeoutInBlocks`.
    function timeoutBlocks() external view returns (uint256) {
        return timeoutInBlocks();
    }

    /// @notice Generation 3's name of `keepAliveBlock`.
    function keepaliveBlock() external view returns (uint256) {
        return keepAliveBlock();
    }

    /// Slices of the one shape that the arguments of `finalize` have.
    function _readFinalize(bytes calldata arguments)
        private
        pure
        returns (bytes calldata result, bool success, bytes calldata signature)
    {
        if (arguments.length != 352) revert MalformedResult();
        bool laidOut = _word(arguments, 0) == 128 && _word(arguments, 32) <= 1 && _word(arguments, 64) == 224
            && _word(arguments, 128) == 34 && _word(arguments, 224) == 65;
        if (!laidOut) revert MalformedResult();
        return (arguments[160:194], _word(arguments, 32) == 1, arguments[256:321]);
    }

    function _word(bytes calldata data, uint256 offset) private pure returns (uint256) {
        return uint256(bytes32(data[offset:offset + 32]));
    }

    /// @param data a call and, behind its arguments, the address of the provider, for whom the factory takes a
    /// lighthouse's word.
    function _callFactory(bytes memory data) private {
        (bool ok, bytes memory answer) = factory.call(data);
        if (ok) return;
        assembly ("memory-safe") {
            revert(add(answer, 0x20), mload(answer))
        }
    }
}
