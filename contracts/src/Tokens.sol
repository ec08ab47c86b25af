// SPDX-License-Identifier: Apache-2.0
pragma solidity ^0.8.28;

import {OrderErrors} from "./Errors.sol";

interface IERC20 {
    function balanceOf(address account) external view returns (uint256);
    function transfer(address to, uint256 value) external returns (bool);
    function transferFrom(address from, address to, uint256 value) external returns (bool);
}

/// @title Moving tokens of which nothing is known but that they say they are ERC-20.
library Tokens {
    /// @notice Pays `value` out; tokens that return nothing are taken at their word.
    function pay(address token, address to, uint256 value) internal {
        _call(token, abi.encodeCall(IERC20.transfer, (to, value)));
    }

    /// @notice Takes `value` of what `from` has approved.
    function take(address token, address from, address to, uint256 value) internal {
        _call(token, abi.encodeCall(IERC20.transferFrom, (from, to, value)));
    }

    /// @notice As `take` into this contract, and makes sure that exactly `value` has arrived: a token that keeps a part
    /// would leave the last one to be paid with nothing.
    function takeExactly(address token, address from, uint256 value) internal {
        if (token.code.length == 0) revert OrderErrors.TokenTransferFailed(token);
        uint256 before = IERC20(token).balanceOf(address(this));
        take(token, from, address(this), value);
        uint256 afterwards = IERC20(token).balanceOf(address(this));
        uint256 received = afterwards > before ? afterwards - before : 0;
        // slither-disable-next-line reentrancy-balance (whoever comes back makes the sums differ, and all is undone)
        if (received != value) revert OrderErrors.TokenAmountMismatch(token, value, received);
    }

    function _call(address token, bytes memory data) private {
        (bool ok, bytes memory answer) = token.call(data);
        if (!ok && answer.length > 0) {
            assembly ("memory-safe") {
                revert(add(answer, 0x20), mload(answer))
            }
        }
        bool silent = answer.length == 0 && token.code.length > 0;
        bool agreed = answer.length >= 32 && uint256(bytes32(answer)) == 1;
        if (!ok || !(silent || agreed)) revert OrderErrors.TokenTransferFailed(token);
    }
}
