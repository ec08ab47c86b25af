// SPDX-License-Identifier: Apache-2.0
pragma solidity ^0.8.28;

import {IValidator} from "./IValidator.sol";
import {XRT} from "./XRT.sol";

/// @title A validator of generation 5: results count that one of its jurors has signed.
/// @notice Parties name it in demand and offer. The promisor hands its result to a juror, who looks at it and signs the
/// same message, with `success` as the juror sees it. A sample and no part of the market: any contract that answers
/// `isValidator` will do, but it has to have a way to get its fees out.
contract Jury is IValidator {
    /// @notice Who names the jurors and receives the fees.
    address public immutable keeper;
    /// @notice The token in which validators are paid.
    XRT public immutable xrt;

    /// @inheritdoc IValidator
    mapping(address signer => bool) public isValidator;

    event Named(address indexed juror, bool indexed serves);

    error NotTheKeeper(address caller);

    modifier onlyKeeper() {
        if (msg.sender != keeper) revert NotTheKeeper(msg.sender);
        _;
    }

    /// @notice The deployer is the keeper.
    constructor(XRT xrt_) {
        keeper = msg.sender;
        xrt = xrt_;
    }

    /// @notice Lets an account judge from now on, or no more; liabilities that are open follow at once.
    function name(address juror, bool serves) external onlyKeeper {
        isValidator[juror] = serves;
        emit Named(juror, serves);
    }

    /// @notice Pays fees out to the keeper.
    /// @param value wn.
    function collect(uint256 value) external onlyKeeper {
        // slither-disable-next-line unchecked-transfer (XRT returns true or reverts)
        xrt.transfer(keeper, value);
    }
}
