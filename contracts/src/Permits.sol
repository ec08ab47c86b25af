// SPDX-License-Identifier: Apache-2.0
pragma solidity ^0.8.28;

import {OrderErrors} from "./Errors.sol";
import {Signatures} from "./Signatures.sol";

/// @notice What EIP-2612 adds to a token.
interface IERC20Permit {
    function permit(
        address owner,
        address spender,
        uint256 value,
        uint256 deadline,
        uint8 v,
        bytes32 r,
        bytes32 s
    ) external;
    function nonces(address owner) external view returns (uint256);
    // slither-disable-next-line naming-convention (EIP-2612 has it so)
    function DOMAIN_SEPARATOR() external view returns (bytes32);
}

/// @notice An approval of this contract that its owner has signed, and that anybody may bring to the token.
struct Permit {
    /// In the token's smallest unit.
    uint256 value;
    /// The last second in which the token takes it.
    uint256 deadline;
    uint8 v;
    bytes32 r;
    bytes32 s;
}

/// @title Approvals that come as a signature (EIP-2612), so that their owner sends no transaction.
library Permits {
    bytes32 internal constant PERMIT =
        keccak256("Permit(address owner,address spender,uint256 value,uint256 nonce,uint256 deadline)");

    /// @notice Brings a permit for this contract to the token. What comes of it is not asked: somebody may have brought
    /// it before, and then the approval stands. A transfer says whether it is enough.
    function submit(address token, address owner, Permit memory permit) internal {
        bytes memory data = abi.encodeCall(
            IERC20Permit.permit, (owner, address(this), permit.value, permit.deadline, permit.v, permit.r, permit.s)
        );
        assembly ("memory-safe") {
            // Without a copy of what it returns, which could be long.
            pop(call(gas(), token, 0, add(data, 0x20), mload(data), 0, 0))
        }
    }

    /// @notice Demands that the owner has signed this permit for this contract, and that the token has taken it, or
    /// another one with its nonce, as the owner's last. That the call of `permit` succeeded would say less: there are
    /// tokens on which every call does.
    function requireLast(address token, address owner, Permit memory permit) internal view {
        // With the nonce 0 it is one that no token has come to.
        uint256 nonce;
        unchecked {
            nonce = IERC20Permit(token).nonces(owner) - 1;
        }
        bytes32 digest = digestOf(
            IERC20Permit(token).DOMAIN_SEPARATOR(), owner, address(this), permit.value, nonce, permit.deadline
        );
        address signer = Signatures.recoverDigest(digest, permit.v, permit.r, permit.s);
        if (signer != owner) revert OrderErrors.FeeNotPermitted(owner);
    }

    /// @notice What the owner signs (EIP-712).
    function digestOf(
        bytes32 domain,
        address owner,
        address spender,
        uint256 value,
        uint256 nonce,
        uint256 deadline
    ) internal pure returns (bytes32) {
        bytes32 fields = keccak256(abi.encode(PERMIT, owner, spender, value, nonce, deadline));
        return keccak256(abi.encodePacked(hex"1901", domain, fields));
    }
}
