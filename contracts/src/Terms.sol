// SPDX-License-Identifier: Apache-2.0
pragma solidity ^0.8.28;

/// @notice What promisee and promisor agreed on.
struct Terms {
    /// 3 or 5: which network's messages made the liability.
    uint256 generation;
    /// sha2-256 digests of the 34-byte multihashes.
    bytes32 model;
    bytes32 objective;
    address promisee;
    address promisor;
    address lighthouse;
    address token;
    address validator;
    /// In the smallest unit of `token`.
    uint256 cost;
    /// In wn.
    uint256 lighthouseFee;
    uint256 validatorFee;
    /// The block of creation.
    uint256 createdAt;
    /// Generation 5: the rest of what was signed, from which the hashes are derived again.
    uint256 demandDeadline;
    uint256 offerDeadline;
    uint256 demandNonce;
    uint256 offerNonce;
    /// Generation 3: the hashes themselves.
    bytes32 demandHash;
    bytes32 offerHash;
}

/// @title Terms as the bytes behind a liability's proxy code.
/// @notice Layout: model 32, objective 32, promisee 20, promisor 20, lighthouse 20, flags 1, and where the flags say
/// so token 20, validator 20 and the numbers cost, lighthouseFee, validatorFee. Then createdAt; then in generation 3
/// demandHash 32 and offerHash 32, in generation 5 the numbers demandDeadline and offerDeadline, counted from
/// createdAt, demandNonce and offerNonce. A number is a byte of length and that many bytes.
library TermsCode {
    uint256 private constant GENERATION_3 = 1;
    uint256 private constant OTHER_TOKEN = 2;
    uint256 private constant VALIDATOR = 4;
    uint256 private constant COST = 8;
    uint256 private constant LIGHTHOUSE_FEE = 16;
    uint256 private constant VALIDATOR_FEE = 32;

    /// All fixed fields and eight numbers of 33 bytes, rounded up.
    uint256 private constant LONGEST = 512;

    /// @param xrt is left out when it is the token.
    function pack(Terms memory terms, address xrt) internal pure returns (bytes memory packed) {
        packed = new bytes(LONGEST);
        uint256 start;
        assembly ("memory-safe") {
            start := add(packed, 0x20)
        }
        uint256 end = _putParties(start, terms);
        end = _putChosen(end, terms, _flags(terms, xrt));
        end = _putNumber(end, terms.createdAt);
        end = terms.generation == 3 ? _putHashes(end, terms) : _putSigned(end, terms);
        assembly ("memory-safe") {
            mstore(packed, sub(end, start))
        }
    }

    /// @param cursor where in memory the terms begin, after the proxy's code.
    function unpack(uint256 cursor, address xrt) internal pure returns (Terms memory terms) {
        cursor = _takeParties(cursor, terms);
        uint256 flags = _take(cursor, 1);
        cursor = _takeChosen(cursor + 1, terms, flags, xrt);
        (terms.createdAt, cursor) = _takeNumber(cursor);
        if (flags & GENERATION_3 != 0) _takeHashes(cursor, terms);
        else _takeSigned(cursor, terms);
    }

    function _flags(Terms memory terms, address xrt) private pure returns (uint256 flags) {
        if (terms.generation == 3) flags |= GENERATION_3;
        if (terms.token != xrt) flags |= OTHER_TOKEN;
        if (terms.validator != address(0)) flags |= VALIDATOR;
        if (terms.cost != 0) flags |= COST;
        if (terms.lighthouseFee != 0) flags |= LIGHTHOUSE_FEE;
        if (terms.validatorFee != 0) flags |= VALIDATOR_FEE;
    }

    function _putParties(uint256 cursor, Terms memory terms) private pure returns (uint256) {
        cursor = _put(cursor, uint256(terms.model), 32);
        cursor = _put(cursor, uint256(terms.objective), 32);
        cursor = _put(cursor, uint160(terms.promisee), 20);
        cursor = _put(cursor, uint160(terms.promisor), 20);
        return _put(cursor, uint160(terms.lighthouse), 20);
    }

    function _takeParties(uint256 cursor, Terms memory terms) private pure returns (uint256) {
        terms.model = bytes32(_take(cursor, 32));
        terms.objective = bytes32(_take(cursor + 32, 32));
        terms.promisee = address(uint160(_take(cursor + 64, 20)));
        terms.promisor = address(uint160(_take(cursor + 84, 20)));
        terms.lighthouse = address(uint160(_take(cursor + 104, 20)));
        return cursor + 124;
    }

    function _putChosen(uint256 cursor, Terms memory terms, uint256 flags) private pure returns (uint256) {
        cursor = _put(cursor, flags, 1);
        if (flags & OTHER_TOKEN != 0) cursor = _put(cursor, uint160(terms.token), 20);
        if (flags & VALIDATOR != 0) cursor = _put(cursor, uint160(terms.validator), 20);
        if (flags & COST != 0) cursor = _putNumber(cursor, terms.cost);
        if (flags & LIGHTHOUSE_FEE != 0) cursor = _putNumber(cursor, terms.lighthouseFee);
        if (flags & VALIDATOR_FEE != 0) cursor = _putNumber(cursor, terms.validatorFee);
        return cursor;
    }

    function _takeChosen(uint256 cursor, Terms memory terms, uint256 flags, address xrt)
        private
        pure
        returns (uint256)
    {
        terms.generation = flags & GENERATION_3 != 0 ? 3 : 5;
        terms.token = xrt;
        if (flags & OTHER_TOKEN != 0) (terms.token, cursor) = (address(uint160(_take(cursor, 20))), cursor + 20);
        if (flags & VALIDATOR != 0) (terms.validator, cursor) = (address(uint160(_take(cursor, 20))), cursor + 20);
        if (flags & COST != 0) (terms.cost, cursor) = _takeNumber(cursor);
        if (flags & LIGHTHOUSE_FEE != 0) (terms.lighthouseFee, cursor) = _takeNumber(cursor);
        if (flags & VALIDATOR_FEE != 0) (terms.validatorFee, cursor) = _takeNumber(cursor);
        return cursor;
    }

    function _putHashes(uint256 cursor, Terms memory terms) private pure returns (uint256) {
        cursor = _put(cursor, uint256(terms.demandHash), 32);
        return _put(cursor, uint256(terms.offerHash), 32);
    }

    function _takeHashes(uint256 cursor, Terms memory terms) private pure {
        terms.demandHash = bytes32(_take(cursor, 32));
        terms.offerHash = bytes32(_take(cursor + 32, 32));
    }

    function _putSigned(uint256 cursor, Terms memory terms) private pure returns (uint256) {
        cursor = _putNumber(cursor, terms.demandDeadline - terms.createdAt);
        cursor = _putNumber(cursor, terms.offerDeadline - terms.createdAt);
        cursor = _putNumber(cursor, terms.demandNonce);
        return _putNumber(cursor, terms.offerNonce);
    }

    function _takeSigned(uint256 cursor, Terms memory terms) private pure {
        (terms.demandDeadline, cursor) = _takeNumber(cursor);
        (terms.offerDeadline, cursor) = _takeNumber(cursor);
        (terms.demandNonce, cursor) = _takeNumber(cursor);
        (terms.offerNonce, cursor) = _takeNumber(cursor);
        terms.demandDeadline += terms.createdAt;
        terms.offerDeadline += terms.createdAt;
    }

    function _putNumber(uint256 cursor, uint256 value) private pure returns (uint256 next) {
        assembly ("memory-safe") {
            let size := 0
            for {} shr(mul(8, size), value) {} { size := add(size, 1) }
            mstore8(cursor, size)
            mstore(add(cursor, 1), shl(sub(256, mul(8, size)), value))
            next := add(add(cursor, 1), size)
        }
    }

    function _takeNumber(uint256 cursor) private pure returns (uint256 value, uint256 next) {
        assembly ("memory-safe") {
            let size := byte(0, mload(cursor))
            value := shr(sub(256, mul(8, size)), mload(add(cursor, 1)))
            next := add(add(cursor, 1), size)
        }
    }

    /// Writes the last `size` bytes of `word`; what it writes behind them is overwritten by the next.
    function _put(uint256 cursor, uint256 word, uint256 size) private pure returns (uint256 next) {
        assembly ("memory-safe") {
            mstore(cursor, shl(sub(256, mul(8, size)), word))
            next := add(cursor, size)
        }
    }

    function _take(uint256 cursor, uint256 size) private pure returns (uint256 word) {
        assembly ("memory-safe") {
            word := shr(sub(256, mul(8, size)), mload(cursor))
        }
    }
}
