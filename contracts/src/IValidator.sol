// SPDX-License-Identifier: Apache-2.0
pragma solidity ^0.8.28;

/// @title A generation-5 validator: the contract that says whose results count.
interface IValidator {
    /// @notice Asked by the liability itself while it is finalized, so `msg.sender` is the liability.
    /// @param signer who signed the result, or the address that stands for several signers (see Signatures).
    function isValidator(address signer) external returns (bool);
}
