// SPDX-License-Identifier: Apache-2.0
pragma solidity ^0.8.28;

import {IENS, IResolver} from "./IENS.sol";

/// @title The resolver of a private chain: addresses of names (EIP-137), and multihashes of models that have names.
/// @notice A name without an address of its own is that of the contract which owns it. So a lighthouse that is given
/// its name needs no record here, and as it never gives the name away, nobody can point it elsewhere.
contract Resolver is IResolver {
    IENS private immutable _ens;
    mapping(bytes32 node => address) private _addresses;

    /// @inheritdoc IResolver
    mapping(bytes32 node => bytes) public multihash;

    error NotTheOwner(bytes32 node, address caller);

    modifier onlyOwner(bytes32 node) {
        if (_ens.owner(node) != msg.sender) revert NotTheOwner(node, msg.sender);
        _;
    }

    /// @param ens the registry whose owners may set addresses here.
    constructor(IENS ens) {
        _ens = ens;
    }

    /// @inheritdoc IResolver
    function addr(bytes32 node) external view returns (address) {
        address known = _addresses[node];
        if (known != address(0)) return known;
        address owner = _ens.owner(node);
        return owner.code.length > 0 ? owner : address(0);
    }

    /// @inheritdoc IResolver
    function setAddr(bytes32 node, address a) external onlyOwner(node) {
        _addresses[node] = a;
        emit AddrChanged(node, a);
    }

    /// @inheritdoc IResolver
    function setMultihash(bytes32 node, bytes calldata hash) external onlyOwner(node) {
        multihash[node] = hash;
        emit MultihashChanged(node, hash);
    }

    /// @notice EIP-165: this interface itself, `addr(bytes32)` and `multihash(bytes32)`.
    function supportsInterface(bytes4 interfaceId) external pure returns (bool) {
        return interfaceId == 0x01ffc9a7 || interfaceId == IResolver.addr.selector
            || interfaceId == IResolver.multihash.selector;
    }
}
