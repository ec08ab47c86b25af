// SPDX-License-Identifier: Apache-2.0
pragma solidity ^0.8.28;

import {TokenErrors} from "./Errors.sol";
import {Permits} from "./Permits.sol";
import {Signatures} from "./Signatures.sol";

/// @title XRT, the network's token: ERC-20 with 9 decimals, so that 1 XRT = 10^9 wn.
/// @notice Providers stake it and are paid in it; the factory mints it for work that was paid for.
contract XRT is TokenErrors {
    string public constant name = "Robonomics";
    string public constant symbol = "XRT";
    uint8 public constant decimals = 9;

    /// Together in one slot, for they are read together when tokens are minted.
    uint96 private _supply;
    /// @notice The one account that may mint, the factory; zero until the deployer names it.
    address public minter;

    /// @notice wn that an account holds.
    mapping(address account => uint256) public balanceOf;
    /// @notice wn that `spender` may still take from `owner`; the maximum is never used up.
    mapping(address owner => mapping(address spender => uint256)) public allowance;
    /// @notice The nonce that an account's next permit is signed with (EIP-2612).
    mapping(address owner => uint256) public nonces;
    address private immutable _deployer = msg.sender;
    uint256 private immutable _chain = block.chainid;
    bytes32 private immutable _domain;

    event Transfer(address indexed from, address indexed to, uint256 value);
    event Approval(address indexed owner, address indexed spender, uint256 value);

    error NotTheMinter(address caller);
    error NotTheDeployer(address caller);
    error MinterAlreadySet();
    /// There can be 2^96-1 wn.
    error SupplyTooLarge(uint256 supply);

    /// @param initialSupply wn that the deployer receives.
    constructor(uint256 initialSupply) {
        _domain = _domainSeparator();
        _mint(msg.sender, initialSupply);
    }

    /// @notice All wn in existence.
    function totalSupply() external view returns (uint256) {
        return _supply;
    }

    /// @notice Names the minter, once and for ever.
    function setMinter(address account) external {
        if (msg.sender != _deployer) revert NotTheDeployer(msg.sender);
        if (minter != address(0)) revert MinterAlreadySet();
        // slither-disable-next-line missing-zero-check (zero is nobody, and can be set again)
        minter = account;
    }

    /// @notice Creates `value` wn for `account`, or as many as there can still be; for the minter alone.
    function mint(address account, uint256 value) external returns (bool) {
        if (msg.sender != minter) revert NotTheMinter(msg.sender);
        uint256 left = type(uint96).max - _supply;
        _mint(account, value < left ? value : left);
        return true;
    }

    function approve(address spender, uint256 value) external returns (bool) {
        allowance[msg.sender][spender] = value;
        emit Approval(msg.sender, spender, value);
        return true;
    }

    /// @notice Approves as `approve` of the owner does, by the owner's signature (EIP-2612); anybody may call.
    /// @param deadline the last second, as blocks have it, in which it counts.
    function permit(
        address owner,
        address spender,
        uint256 value,
        uint256 deadline,
        uint8 v,
        bytes32 r,
        bytes32 s
    ) external {
        // slither-disable-next-line timestamp (EIP-2612 has it so)
        if (block.timestamp > deadline) revert ERC2612ExpiredSignature(deadline);
        bytes32 digest = Permits.digestOf(DOMAIN_SEPARATOR(), owner, spender, value, nonces[owner]++, deadline);
        address signer = Signatures.recoverDigest(digest, v, r, s);
        if (signer != owner) revert ERC2612InvalidSigner(signer, owner);
        allowance[owner][spender] = value;
        emit Approval(owner, spender, value);
    }

    function transfer(address to, uint256 value) external returns (bool) {
        _transfer(msg.sender, to, value);
        return true;
    }

    function transferFrom(address from, address to, uint256 value) external returns (bool) {
        uint256 allowed = allowance[from][msg.sender];
        if (allowed < value) revert ERC20InsufficientAllowance(msg.sender, allowed, value);
        if (allowed != type(uint256).max) {
            unchecked {
                allowance[from][msg.sender] = allowed - value;
            }
        }
        _transfer(from, to, value);
        return true;
    }

    /// @notice What ties a permit to this token on this chain (EIP-712); another one after the chain has split in two.
    // slither-disable-next-line naming-convention (EIP-2612 has it so)
    function DOMAIN_SEPARATOR() public view returns (bytes32) {
        return block.chainid == _chain ? _domain : _domainSeparator();
    }

    function _domainSeparator() private view returns (bytes32) {
        return keccak256(
            abi.encode(
                keccak256("EIP712Domain(string name,string version,uint256 chainId,address verifyingContract)"),
                keccak256(bytes(name)),
                keccak256("1"),
                block.chainid,
                address(this)
            )
        );
    }

    function _transfer(address from, address to, uint256 value) private {
        if (to == address(0)) revert ERC20InvalidReceiver(to);
        uint256 balance = balanceOf[from];
        if (balance < value) revert ERC20InsufficientBalance(from, balance, value);
        // A sum of balances is the supply, and that is known to fit from _mint.
        unchecked {
            balanceOf[from] = balance - value;
            balanceOf[to] += value;
        }
        emit Transfer(from, to, value);
    }

    function _mint(address account, uint256 value) private {
        if (account == address(0)) revert ERC20InvalidReceiver(account);
        uint256 supply = _supply + value;
        if (supply > type(uint96).max) revert SupplyTooLarge(supply);
        _supply = uint96(supply);
        unchecked {
            balanceOf[account] += value;
        }
        emit Transfer(address(0), account, value);
    }
}
