// SPDX-License-Identifier: Apache-2.0
pragma solidity ^0.8.28;

import {OrderErrors} from "./Errors.sol";

/// @title Signatures as the network makes them: ECDSA over the Ethereum prefix and a message hash (EIP-191).
library Signatures {
    /// Half the order of secp256k1: of the two signatures with the same r, only the one with the lower s counts.
    uint256 private constant HALF_ORDER = 0x7FFFFFFFFFFFFFFFFFFFFFFFFFFFFFFF5D576E7357A4501DDFE92F46681B20A0;

    /// @notice Who has signed: for 65 bytes the signer, for more the address that stands for all signers.
    /// @param signatures 65 bytes each, in strictly ascending order of their signers.
    function recoverAll(bytes32 hash, bytes calldata signatures) internal pure returns (address) {
        if (signatures.length <= 65) return recover(hash, signatures);
        if (signatures.length % 65 != 0) revert OrderErrors.InvalidSignature();
        address[] memory signers = new address[](signatures.length / 65);
        address previous = address(0);
        for (uint256 i = 0; i < signers.length; ++i) {
            address signer = recover(hash, signatures[65 * i:65 * i + 65]);
            if (signer <= previous) revert OrderErrors.SignersOutOfOrder(previous, signer);
            (signers[i], previous) = (signer, signer);
        }
        return standIn(signers);
    }

    /// @notice The address that stands for several signers: the last 20 bytes of the hash of their addresses, each in a
    /// word of 32 bytes. No account has it but by chance.
    /// @param signers in ascending order.
    function standIn(address[] memory signers) internal pure returns (address signer) {
        assembly ("memory-safe") {
            signer := shr(96, shl(96, keccak256(add(signers, 0x20), shl(5, mload(signers)))))
        }
    }

    /// @param signature r ‖ s ‖ v, 65 bytes.
    function recover(bytes32 hash, bytes calldata signature) internal pure returns (address) {
        if (signature.length != 65) revert OrderErrors.InvalidSignature();
        return recover(hash, uint8(signature[64]), bytes32(signature[:32]), bytes32(signature[32:64]));
    }

    /// @return signer never the zero address.
    function recover(bytes32 hash, uint8 v, bytes32 r, bytes32 s) internal pure returns (address signer) {
        bytes32 prefixed;
        assembly ("memory-safe") {
            mstore(0, "\x19Ethereum Signed Message:\n32")
            mstore(28, hash)
            prefixed := keccak256(0, 60)
        }
        return recoverDigest(prefixed, v, r, s);
    }

    /// @notice As `recover`, of what was signed without the prefix (EIP-712).
    function recoverDigest(bytes32 digest, uint8 v, bytes32 r, bytes32 s) internal pure returns (address signer) {
        if (uint256(s) > HALF_ORDER) revert OrderErrors.InvalidSignature();
        // Zero for every v but 27 and 28, and for what no key can have signed.
        signer = ecrecover(digest, v, r, s);
        if (signer == address(0)) revert OrderErrors.InvalidSignature();
    }
}
