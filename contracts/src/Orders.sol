// SPDX-License-Identifier: Apache-2.0
pragma solidity ^0.8.28;

import {OrderErrors} from "./Errors.sol";
import {Signatures} from "./Signatures.sol";

/// @notice A demand or an offer as the words of its canonical `abi.encode`, which has one shape only: ten words of
/// head, then model, objective and signature with their lengths.
struct Order {
    uint256 modelAt;
    uint256 objectiveAt;
    uint256 token;
    uint256 cost;
    /// Demand: lighthouse, validator. Offer: validator, lighthouse.
    uint256 firstAccount;
    uint256 secondAccount;
    /// Demand: validatorFee. Offer: lighthouseFee.
    uint256 fee;
    uint256 deadline;
    /// Generation 3: a nonce of 32 bytes. Generation 5: an address.
    uint256 nonceOrSender;
    uint256 signatureAt;
    uint256 modelLength;
    bytes32 modelHead;
    bytes32 modelTail;
    uint256 objectiveLength;
    bytes32 objectiveHead;
    bytes32 objectiveTail;
    uint256 signatureLength;
    bytes32 r;
    bytes32 s;
    bytes32 v;
}

/// @title Reading, comparing and hashing orders of both generations.
library Orders {
    /// A multihash is 0x12 (sha2-256), 0x20 (32 bytes) and the digest.
    uint256 internal constant MULTIHASH = 0x1220;
    uint256 private constant SIZE = 20 * 32;

    /// @notice The order in `data`, which must be its canonical encoding, down to the padding.
    function read(bytes calldata data) internal pure returns (Order calldata order) {
        if (data.length != SIZE) revert OrderErrors.MalformedOrder();
        assembly ("memory-safe") {
            order := data.offset
        }
        // Every bit that must not be set, and every bit in which a fixed word differs.
        // slither-disable-next-line incorrect-exp (exclusive or is meant)
        uint256 wrong = (order.modelAt ^ 320) | (order.objectiveAt ^ 416) | (order.signatureAt ^ 512);
        // slither-disable-next-line incorrect-exp (exclusive or is meant)
        wrong |= (order.modelLength ^ 34) | (order.objectiveLength ^ 34) | (order.signatureLength ^ 65);
        wrong |= (uint256(order.modelHead) >> 240 ^ MULTIHASH) | (uint256(order.objectiveHead) >> 240 ^ MULTIHASH);
        wrong |= (order.token | order.firstAccount | order.secondAccount) >> 160;
        wrong |= uint256(order.modelTail << 16) | uint256(order.objectiveTail << 16) | uint256(order.v << 8);
        if (wrong != 0) revert OrderErrors.MalformedOrder();
    }

    /// @notice Demands that both orders are about the same work on the same terms.
    function requireMatch(Order calldata demand, Order calldata offer) internal pure {
        if (isFifth(demand) != isFifth(offer)) revert OrderErrors.GenerationMismatch();
        if (model(demand) != model(offer)) revert OrderErrors.ModelMismatch();
        if (objective(demand) != objective(offer)) revert OrderErrors.ObjectiveMismatch();
        if (demand.token != offer.token) revert OrderErrors.TokenMismatch();
        if (demand.cost != offer.cost) revert OrderErrors.CostMismatch();
        if (demand.firstAccount != offer.secondAccount) revert OrderErrors.LighthouseMismatch();
        if (demand.secondAccount != offer.firstAccount) revert OrderErrors.ValidatorMismatch();
    }

    /// @notice Whether the order is of generation 5: its ninth word is an address and not a nonce. A generation-3 nonce
    /// that begins with twelve zero bytes is taken for an address and refused, for nobody's signature fits it.
    function isFifth(Order calldata order) internal pure returns (bool) {
        return order.nonceOrSender >> 160 == 0;
    }

    function model(Order calldata order) internal pure returns (bytes32) {
        return digest(order.modelHead, order.modelTail);
    }

    function objective(Order calldata order) internal pure returns (bytes32) {
        return digest(order.objectiveHead, order.objectiveTail);
    }

    /// @notice The last 32 of the 34 bytes that begin with `head`.
    function digest(bytes32 head, bytes32 tail) internal pure returns (bytes32) {
        return (head << 16) | (tail >> 240);
    }

    /// @notice What a generation-3 signer has signed: all fields but the signature, packed in the order of the
    /// encoding.
    function hashThird(Order calldata order) internal pure returns (bytes32 hash) {
        uint256 packed = _packFields(order);
        uint256 nonce = order.nonceOrSender;
        assembly ("memory-safe") {
            mstore(add(packed, 224), nonce)
            hash := keccak256(packed, 256)
        }
    }

    /// @notice What a generation-5 signer has signed: as generation 3, with a counted nonce and the sender.
    function hashFifth(Order calldata order, uint256 nonce) internal pure returns (bytes32 hash) {
        uint256 packed = _packFields(order);
        uint256 sender = order.nonceOrSender;
        assembly ("memory-safe") {
            mstore(add(packed, 224), nonce)
            mstore(add(packed, 256), shl(96, sender))
            hash := keccak256(packed, 276)
        }
    }

    function recover(Order calldata order, bytes32 hash) internal pure returns (address) {
        return Signatures.recover(hash, uint8(bytes1(order.v)), order.r, order.s);
    }

    /// `abi.encodePacked` of the first eight fields, 224 bytes in memory that is not kept. Neighbours are copied
    /// together: model (34 bytes), objective (34), token (20) and cost (32), first account (20), second account (20),
    /// fee (32) and deadline (32).
    function _packFields(Order calldata order) private pure returns (uint256 packed) {
        assembly ("memory-safe") {
            packed := mload(0x40)
            calldatacopy(packed, add(order, 352), 34)
            calldatacopy(add(packed, 34), add(order, 448), 34)
            calldatacopy(add(packed, 68), add(order, 76), 52)
            calldatacopy(add(packed, 120), add(order, 140), 20)
            calldatacopy(add(packed, 140), add(order, 172), 84)
        }
    }
}
