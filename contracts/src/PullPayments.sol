// SPDX-License-Identifier: Apache-2.0
pragma solidity ^0.8.28;

import {RobonomicsErrors} from "./Errors.sol";
import {Tokens} from "./Tokens.sol";

/// @title Pays other people's tokens, and owes what a token refuses to pay.
/// @notice A token can refuse one receiver (a blocklist, a pause, a hook that reverts). That must not keep back what
/// others get in the same transaction, nor the end of a liability.
abstract contract PullPayments is RobonomicsErrors {
    /// Gas of an attempt to pay, all that a token can burn. The same for everybody: who sends the transaction must not
    /// decide whether a payment succeeds.
    uint256 private constant ATTEMPT_GAS = 300_000;
    /// A call passes on 63/64 of the gas that is left, so with less than this an attempt may get less than its gas.
    uint256 private constant GAS_BEFORE_ATTEMPT = 310_000;

    /// @notice What a token refused to pay to an account, in the token's smallest unit; `claim` and `claimTo` pay it.
    mapping(address token => mapping(address account => uint256)) public owed;

    /// @notice The token did not pay the account, which is owed `value` more.
    event PaymentRefused(address indexed token, address indexed account, uint256 value);
    /// @notice The account was paid at `to` all that it was owed.
    event Claimed(address indexed token, address indexed account, address to, uint256 value);

    /// @notice Pays an account all that it is owed; anybody may call.
    function claim(address token, address account) external {
        _claim(token, account, account);
    }

    /// @notice Pays what the caller is owed to another account, for a token that still refuses the caller.
    function claimTo(address token, address to) external {
        _claim(token, msg.sender, to);
    }

    /// @notice Pays a token; for the factory itself, as a call that is undone when the payment fails in any way.
    function pay(address token, address to, uint256 value) external {
        if (msg.sender != address(this)) revert NotTheFactory(msg.sender);
        Tokens.pay(token, to, value);
    }

    /// Pays, or owes. Nothing that the token returns is copied here, so that it can't take more gas than an attempt has.
    // slither-disable-start reentrancy-benign,reentrancy-events (what is added to is read after the call)
    function _payOrOwe(address token, address to, uint256 value) internal {
        uint256 left = gasleft();
        try this.pay{gas: ATTEMPT_GAS}(token, to, value) {}
        catch {
            if (left < GAS_BEFORE_ATTEMPT) revert TooLittleGas(left, GAS_BEFORE_ATTEMPT);
            owed[token][to] += value;
            emit PaymentRefused(token, to, value);
        }
    }
    // slither-disable-end reentrancy-benign,reentrancy-events

    function _claim(address token, address account, address to) private {
        uint256 value = owed[token][account];
        if (value == 0) revert NothingOwed(token, account);
        owed[token][account] = 0;
        emit Claimed(token, account, to, value);
        Tokens.pay(token, to, value);
    }
}
