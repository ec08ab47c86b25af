"""What to do when a contract refuses: a line for each reason that people give it."""

from __future__ import annotations

from types import MappingProxyType
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from collections.abc import Mapping

HINTS: Final[Mapping[str, str]] = MappingProxyType(
    {
        "ERC20InsufficientAllowance": "approve the spender for that amount first",
        "ERC20InsufficientBalance": "send the account the missing tokens, or lower the amount",
        "ERC20InvalidReceiver": "check the address that the tokens are to go to",
        "DeadlineReached": "the order has expired; sign a new one with a later deadline",
        "OrderUsed": "an order makes one contract only; sign a new one",
        "WrongSigner": "the signature is another account's than the first address says, or of other terms",
        "InvalidSignature": "a signature is 65 bytes with v 27 or 28 and a low s",
        "NotAProvider": "stake on the lighthouse first: only its providers may send to it",
        "NotTheValidator": "the contract names a validator, and only that account can finalize it",
        "AlreadyFinalized": "it has ended; its record says how",
        "RefundTooEarly": "wait for that block: until then the promisor may bring a result",
        "NameTaken": "choose another name",
        "InvalidName": "a name is one label of a to z, 0 to 9 and -, of 32 characters at most",
        "InvalidStake": "the minimal stake is at least 1 wn",
        "InvalidTimeout": "the timeout is at least 1 block",
        "StakeTooSmall": "stake the lighthouse's minimum at least",
        "InsufficientStake": "no more can be withdrawn than was staked",
        "OutOfGas": "the contract's state has changed since it was asked; send it again",
    }
)
"""By the name of the custom error, as `Reverted.reason` has it."""
