"""Rejections: why a provider can't use a message, signed and published for its sender; and which order is at fault."""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING, Any, Final

from mesh.chain.errors import Reverted
from mesh.flood import Rate, RateLimiter
from mesh.log_context import log_event
from mesh.market.refusals import Refusal
from schemas import RejectKey, address_bytes
from schemas.signing import Rejection

if TYPE_CHECKING:
    from collections.abc import Sequence

    from mesh.chain import Account
    from mesh.errors import AiraError
    from mesh.flood import Drops
    from mesh.market.book import Match, Order
    from mesh.market.earnings import EarningsLedger
    from mesh.network import Channel
    from schemas import Verified, Withdrawal

log = logging.getLogger(__name__)

PER_MAKER: Final = Rate(per_second=5.0, burst=500)
"""Rejections of one maker's messages."""
TOTAL: Final = Rate(per_second=50.0, burst=1000)
"""Rejections in all: each is signed, logged and published."""
ORDER_USED: Final = "OrderUsed"
"""The contracts' error for an order that became a liability, or was withdrawn there."""
UNNAMED_ERROR: Final = "Reverted"
"""The reason of a rejection when the contract's error has no name."""


class RejectionPublisher:
    """Counts the rejections of a provider's `account` in `earnings`, and publishes them on the market's `channel`.

    Beyond a rate they are only counted, in `drops` too.
    """

    def __init__(self, channel: Channel, account: Account, earnings: EarningsLedger, drops: Drops) -> None:
        self._channel = channel
        self._account = account
        self._earnings = earnings
        self._drops = drops
        self._limiter = RateLimiter(per_sender=PER_MAKER, total=TOTAL)

    def reject(self, message: Verified[Any], reason: str, detail: str) -> None:
        """Count and publish a rejection. A used order's sender knows already that it became a contract."""
        self._earnings.rejected(reason)
        if not self._limiter.allow(message.signer):
            self._drops.count("rejections", message.signer)
            return
        order = message.hash.hex()
        event = log_event("message-rejected", order=order, signer=message.signer, reason=reason)
        level = logging.INFO if reason == Refusal.WITHDRAWN else logging.WARNING
        log.log(level, "rejected %s of %s: %s", order, message.signer, detail, extra=event)
        if reason != ORDER_USED:
            self._publish(message.signer, order, reason, detail)

    def honour(self, withdrawal: Verified[Withdrawal]) -> None:
        """Publish, as a rejection of the withdrawn order, that this provider does not match it."""
        if not self._limiter.allow(withdrawal.signer):
            self._drops.count("rejections", withdrawal.signer)
            return
        order = withdrawal.message.order
        event = log_event("withdrawal-honoured", order=order, signer=withdrawal.signer)
        log.info("%s withdrew the order %s", withdrawal.signer, order, extra=event)
        detail = "its maker has withdrawn it; this provider does not match it"
        self._publish(withdrawal.signer, order, Refusal.WITHDRAWN.value, detail)

    def _publish(self, maker: str, order: str, reason: str, detail: str) -> None:
        provider = self._account.address
        rejection = Rejection(order=order, reason=reason, detail=detail, provider=provider)
        key = str(RejectKey(self._channel.lighthouse, maker))
        self._channel.put(key, rejection.signed_by(self._account.signer).encode())


def at_fault(match: Match, error: str, arguments: Sequence[Any]) -> tuple[Verified[Order], ...]:
    """The orders that caused the contracts' `error` (name of a custom error) when a match was not created.

    Both orders, if the error and its arguments don't tell them apart.
    """
    both: tuple[Verified[Order], ...] = (match.demand, match.offer)
    match error, *arguments:
        case name, used if name == ORDER_USED:
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


def reason_of(error: AiraError) -> str:
    """The machine-readable reason of a rejection: never a text that a stranger's token chose."""
    word = error.reason if isinstance(error, Reverted) else type(error).__name__
    return word if word.isidentifier() else UNNAMED_ERROR


def _bytes(value: bytes | str) -> bytes:
    return bytes.fromhex(value.removeprefix("0x")) if isinstance(value, str) else bytes(value)
