"""Whose order it is when a pair can't become a contract: so that the other one stays in the market. Pure."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

from schemas import address_bytes

if TYPE_CHECKING:
    from collections.abc import Sequence

    from mesh.market.book import Match, Order
    from schemas import Verified


USED: Final = "OrderUsed"
"""The contracts' error of an order that has become a contract before."""
NAMELESS: Final = "Reverted"
"""What a refusal is called whose contract gave it no name."""


def word_for(reason: str) -> str:
    """A machine-readable word: the name of the contracts' error, but never a text of a stranger's contract."""
    return reason if reason.isidentifier() else NAMELESS


def at_fault(match: Match, reason: str, arguments: Sequence[Any]) -> tuple[Verified[Order], ...]:
    """The orders that the contracts' error `reason` (name of a custom error) with its `arguments` tells of.

    Both, when it does not tell them apart.
    """
    both: tuple[Verified[Order], ...] = (match.demand, match.offer)
    match reason, *arguments:
        case name, used if name == USED:
            return tuple(order for order in both if order.hash == _bytes(used)) or both
        case "DeadlineReached", deadline:
            return tuple(order for order in both if order.message.deadline == deadline) or both
        case "WrongSigner" | "ERC20InsufficientBalance", str(address), *_:
            return tuple(order for order in both if address_bytes(order.signer) == address_bytes(address)) or both
        case "InvalidSignature", *_:
            return both
        case "ERC20InsufficientAllowance", _, _, needed if needed == match.offer.message.lighthouse_fee:
            return both if needed in (match.demand.message.cost, match.demand.message.validator_fee) else (match.offer,)
        case "ERC20InsufficientAllowance" | "ValidatorWithoutCode", *_:
            return (match.demand,)
    return both


def _bytes(value: bytes | str) -> bytes:
    return bytes.fromhex(value.removeprefix("0x")) if isinstance(value, str) else bytes(value)
