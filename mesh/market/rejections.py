"""Rejections: why a provider can't use a message, signed and published for its sender."""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING, Any, Final

from mesh.flood import Rate, RateLimiter
from mesh.log_context import log_event
from mesh.market.book import ORDER_USED, Refusal
from schemas import RejectKey
from schemas.signing import Rejection

if TYPE_CHECKING:
    from mesh.chain import Account
    from mesh.flood import Drops
    from mesh.market.earnings import EarningsLedger
    from mesh.network import Channel
    from schemas import Verified, Withdrawal

log = logging.getLogger(__name__)


PER_MAKER: Final = Rate(per_second=5.0, burst=500)
"""Rejections of one maker's messages."""
TOTAL: Final = Rate(per_second=50.0, burst=1000)
"""Rejections in all: each is signed, logged and published."""


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
