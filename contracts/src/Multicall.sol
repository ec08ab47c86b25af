// SPDX-License-Identifier: Apache-2.0
pragma solidity ^0.8.28;

/// @title Many calls in one `eth_call`, without a contract on the chain.
/// @notice A node is asked to create this contract, and answers with what the creation returns: not code, but the
/// answers to the calls. It is never deployed. Calls can't change anything.
contract Multicall {
    /// @param gasEach The most gas of each call: a stranger's contract must not take that of the others.
    /// @param most The most bytes of each answer; what is longer is cut.
    /// @param calls One after another: the address, the length of the data (2 bytes), and the data. The answers: whether
    /// the call succeeded (1 byte), the length of what it returned (2 bytes), and that.
    constructor(uint256 gasEach, uint256 most, bytes memory calls) {
        assembly ("memory-safe") {
            let answers := mload(0x40)
            let answer := answers
            let call_ := add(calls, 0x20)
            for { let end := add(call_, mload(calls)) } lt(call_, end) {} {
                let length := and(shr(80, mload(call_)), 0xffff)
                let data := add(call_, 22)
                let success := staticcall(gasEach, shr(96, mload(call_)), data, length, 0, 0)
                let size := returndatasize()
                if gt(size, most) { size := most }
                mstore(answer, or(shl(248, success), shl(232, size)))
                returndatacopy(add(answer, 3), 0, size)
                answer := add(add(answer, 3), size)
                call_ := add(data, length)
            }
            return(answers, sub(answer, answers))
        }
    }
}
