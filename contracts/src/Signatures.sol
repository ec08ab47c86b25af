// SPDX-License-Identifier: Apache-2.0
pragma solidity ^0.8.28;

import {OrderErrors} from "./Errors.sol";

/// @title Signatures as the network makes them: ECDSA over the Ethereum prefix and a message hash (EIP-191).
library Signatures {
    /// Half the order of secp256k1: of the two signatures with the same r, only the one with the lower s counts.
    uint256 private constant HALF_ORDER = 0x7FFFFFFFFFFFFFFFFFFFFFFFFFFFFFFF5D576E7357A4501DDFE92F46681B20A0;

    /// @param signature r ‖ s ‖ v, 65 bytes.
    function recover(bytes32 hash, bytes calldata signature) internal pure returns (address) {
        if (signature.length != 65) revert OrderErrors.InvalidSignature();
        return recover(hash, uint8(signature[64]), bytes32(signature[:32]), bytes32(signature[32:64]));
    }

    /// @return signer never the zero address.
    function recover(bytes32 hash, uint8 v, bytes32 r, bytes32 s) internal pure returns (address signer) {
        if (uint256(s) > HALF_ORDER) revert OrderErrors.InvalidSignature();
        bytes32 prefixed;
        assembly ("memory-safe") {
            mstore(0, "\x19Ethereum Signed Message:\n32")
            mstore(28, hash)
            prefixed := keccak256(0, 60)
        }
        // Zero for every v but 27 and 28, and for what no key can have signed.
        signer = ecrecover(prefixed, v, r, s);
        if (signer == address(0)) revert OrderErrors.InvalidSignature();
    }
}
