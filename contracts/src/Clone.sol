// SPDX-License-Identifier: Apache-2.0
pragma solidity ^0.8.28;

/// @title Small proxies whose arguments are their code.
/// @notice A clone is the 45-byte proxy of EIP-1167 followed by arguments that never run. A byte of code costs 200 gas
/// once, a byte of storage about 690. Made by CREATE2, a clone needs no list to be recognised: nobody but its maker can
/// have put this code at this address, so hashing the code again and finding the same address is the proof.
library Clone {
    /// Where the arguments begin in the clone's code.
    uint256 internal constant ARGUMENTS = 45;

    /// Code that returns what follows it is 10 bytes: PUSH2 size, RETURNDATASIZE, DUP2, PUSH1 10, RETURNDATASIZE,
    /// CODECOPY, RETURN. In a word, without the size:
    bytes32 private constant CREATION = hex"6100003d81600a3d39f3";
    uint256 private constant CREATION_SIZE = 10;
    uint256 private constant SIZE_SHIFT = 232;

    error CloneFailed();

    /// @param salt tells kinds of clones of one maker apart.
    /// @return clone the new contract, whose address follows from maker, salt, implementation and arguments.
    function create(address implementation, bytes32 salt, bytes memory arguments) internal returns (address clone) {
        bytes memory creation = abi.encodePacked(
            bytes10(_creation(ARGUMENTS + arguments.length)),
            hex"363d3d373d3d3d363d73",
            implementation,
            hex"5af43d82803e903d91602b57fd5bf3",
            arguments
        );
        assembly ("memory-safe") {
            clone := create2(0, add(creation, 0x20), mload(creation), salt)
        }
        if (clone == address(0)) revert CloneFailed();
    }

    /// @notice Whether this contract made `account` as a clone with this salt.
    /// @return isClone and the place in memory of the clone's arguments.
    function read(address account, bytes32 salt) internal view returns (bool isClone, uint256 arguments) {
        uint256 size = account.code.length;
        bytes32 head = _creation(size);
        bytes32 creationHash;
        assembly ("memory-safe") {
            let creation := mload(0x40)
            let code := add(creation, CREATION_SIZE)
            mstore(creation, head)
            extcodecopy(account, code, 0, size)
            mstore(0x40, add(code, size))
            creationHash := keccak256(creation, add(CREATION_SIZE, size))
            arguments := add(code, ARGUMENTS)
        }
        bytes32 derived = keccak256(abi.encodePacked(hex"ff", address(this), salt, creationHash));
        isClone = address(uint160(uint256(derived))) == account;
    }

    function _creation(uint256 size) private pure returns (bytes32) {
        return CREATION | bytes32(size << SIZE_SHIFT);
    }
}
