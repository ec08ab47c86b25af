// SPDX-License-Identifier: Apache-2.0
pragma solidity ^0.8.28;

import {IENS} from "./IENS.sol";

/// @title The ENS registry for chains that have none (EIP-137).
/// @notice Same interface as the public one. A record is one storage slot: the resolver is kept as its number in a list
/// of resolvers, which are few, so that a new name costs one new slot and not two.
contract ENSRegistry is IENS {
    struct Record {
        address owner;
        uint64 ttl;
        uint32 resolver;
    }

    mapping(bytes32 node => Record) private _records;
    mapping(address resolver => uint32) private _numberOf;
    mapping(uint32 number => address) private _resolvers;
    uint32 private _lastResolver;

    error NotTheOwner(bytes32 node, address caller);

    modifier onlyOwner(bytes32 node) {
        if (_records[node].owner != msg.sender) revert NotTheOwner(node, msg.sender);
        _;
    }

    /// @notice The deployer owns the root node.
    constructor() {
        _records[bytes32(0)].owner = msg.sender;
    }

    /// @inheritdoc IENS
    function owner(bytes32 node) external view returns (address) {
        return _records[node].owner;
    }

    /// @inheritdoc IENS
    function resolver(bytes32 node) external view returns (address) {
        return _resolvers[_records[node].resolver];
    }

    /// @inheritdoc IENS
    function ttl(bytes32 node) external view returns (uint64) {
        return _records[node].ttl;
    }

    /// @inheritdoc IENS
    function recordExists(bytes32 node) external view returns (bool) {
        return _records[node].owner != address(0);
    }

    /// @inheritdoc IENS
    function setOwner(bytes32 node, address newOwner) external onlyOwner(node) {
        _records[node].owner = newOwner;
        emit Transfer(node, newOwner);
    }

    /// @inheritdoc IENS
    function setResolver(bytes32 node, address newResolver) external onlyOwner(node) {
        _records[node].resolver = _number(newResolver);
        emit NewResolver(node, newResolver);
    }

    /// @inheritdoc IENS
    function setTTL(bytes32 node, uint64 newTTL) external onlyOwner(node) {
        _records[node].ttl = newTTL;
        emit NewTTL(node, newTTL);
    }

    /// @inheritdoc IENS
    function setSubnodeOwner(bytes32 node, bytes32 label, address newOwner) external onlyOwner(node) returns (bytes32) {
        bytes32 subnode = keccak256(abi.encodePacked(node, label));
        _records[subnode].owner = newOwner;
        emit NewOwner(node, label, newOwner);
        return subnode;
    }

    /// @inheritdoc IENS
    function setSubnodeRecord(bytes32 node, bytes32 label, address newOwner, address newResolver, uint64 newTTL)
        external
        onlyOwner(node)
    {
        bytes32 subnode = keccak256(abi.encodePacked(node, label));
        _records[subnode] = Record({owner: newOwner, ttl: newTTL, resolver: _number(newResolver)});
        emit NewOwner(node, label, newOwner);
        emit NewResolver(subnode, newResolver);
    }

    function _number(address newResolver) private returns (uint32 number) {
        number = _numberOf[newResolver];
        if (number == 0 && newResolver != address(0)) {
            number = ++_lastResolver;
            _resolvers[number] = newResolver;
            _numberOf[newResolver] = number;
        }
    }
}
