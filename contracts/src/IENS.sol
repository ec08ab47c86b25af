// SPDX-License-Identifier: Apache-2.0
pragma solidity ^0.8.28;

/// @title What the suite needs of an ENS registry (EIP-137); the public one has it all.
interface IENS {
    event NewOwner(bytes32 indexed node, bytes32 indexed label, address owner);
    event Transfer(bytes32 indexed node, address owner);
    event NewResolver(bytes32 indexed node, address resolver);
    event NewTTL(bytes32 indexed node, uint64 ttl);

    /// @notice Who may change the record of `node`; zero for an unknown name.
    function owner(bytes32 node) external view returns (address);
    /// @notice The contract that knows the address of `node`; zero for an unknown name.
    function resolver(bytes32 node) external view returns (address);
    /// @notice Seconds for which a record may be cached.
    function ttl(bytes32 node) external view returns (uint64);
    function recordExists(bytes32 node) external view returns (bool);
    function setOwner(bytes32 node, address newOwner) external;
    function setResolver(bytes32 node, address newResolver) external;
    function setTTL(bytes32 node, uint64 newTTL) external;
    /// @param label keccak256 of the subdomain's own label.
    /// @return The node of the subdomain.
    function setSubnodeOwner(bytes32 node, bytes32 label, address newOwner) external returns (bytes32);
    function setSubnodeRecord(bytes32 node, bytes32 label, address newOwner, address newResolver, uint64 newTTL)
        external;
}

/// @title What the suite needs of a resolver.
interface IResolver {
    event AddrChanged(bytes32 indexed node, address a);
    event MultihashChanged(bytes32 indexed node, bytes hash);

    /// @notice The address of a name; zero for an unknown name, never a revert.
    function addr(bytes32 node) external view returns (address);
    function setAddr(bytes32 node, address a) external;
    /// @notice The content behind a name, as a multihash; empty for an unknown name.
    function multihash(bytes32 node) external view returns (bytes memory);
    function setMultihash(bytes32 node, bytes calldata hash) external;
}
