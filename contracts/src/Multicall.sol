// SPDX-License-Identifier: Apache-2.0
pragma solidity ^0.8.28;

/// @title Many calls in one `eth_call`, without a contract on the chain.
/// @notice A node is asked to create this contract, and answers with what the creation returns: not code, but the
/// answers to the calls, ABI-encoded. It is never deployed. Calls can't change anything.
contract Multicall {
    struct Call {
        address target;
        bytes data;
    }

    struct Answer {
        bool success;
        bytes data;
    }

    constructor(Call[] memory calls) {
        Answer[] memory answers = new Answer[](calls.length);
        for (uint256 index = 0; index < calls.length; ++index) {
            // slither-disable-next-line calls-loop (it is never deployed, and the caller chooses the calls)
            (answers[index].success, answers[index].data) = calls[index].target.staticcall(calls[index].data);
        }
        bytes memory encoded = abi.encode(answers);
        assembly ("memory-safe") {
            return(add(encoded, 32), mload(encoded))
        }
    }
}
