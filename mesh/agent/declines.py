"""Declines: an agent says, signed, that it does not work for a demand, and why."""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING, Final, NamedTuple

from mesh.agent.errors import Declined
from mesh.agent.offers import TooManyOffers
from mesh.content import ContentTooLarge
from mesh.errors import ContentError
from mesh.flood import Rate, RateLimiter
from mesh.log_context import log_event
from mesh.work.objectives import ObjectiveNotFetched, ObjectiveUnfit
from schemas import DeclineKey
from schemas.signing import LONGEST_DETAIL, Decline

if TYPE_CHECKING:
    from mesh.errors import AiraError
    from mesh.flood import Drops
    from mesh.network import Channel
    from schemas import Demand, Signer, Verified

log = logging.getLogger(__name__)

PER_MAKER: Final = Rate(per_second=1.0, burst=32)
"""Declines of one maker's demands."""
TOTAL: Final = Rate(per_second=10.0, burst=200)
"""Declines in all: each is signed, logged and published."""


class Grounds(NamedTuple):
    """Why a demand is declined: a word for programs, and a line for people."""

    code: str
    detail: str


BUSY: Final = Grounds("busy", "too many demands and offers wait; it looks at the demand again when it is sent again")


def grounds_of(error: AiraError) -> Grounds | None:
    """Why a demand is declined whose handler raised this error; None if the error says nothing about the demand."""
    match error:
        case Declined():
            return Grounds(error.reason, error.detail)
        case ObjectiveUnfit():
            return Grounds(error.reason, error.detail)
        case ObjectiveNotFetched(reason="rate" | "shared") | TooManyOffers():
            return BUSY
        case ContentTooLarge():
            return Grounds("too-large", "the objective is larger than it allows")
        case ContentError():  # its own text is about this agent's store and peers
            return Grounds("objective-unavailable", "it could not fetch the objective from anybody")
    return None


class DeclinePublisher:
    """Publishes an agent's declines on its market's `channel`; beyond a rate they are only counted in `drops`."""

    def __init__(self, channel: Channel, signer: Signer, drops: Drops) -> None:
        self._channel = channel
        self._signer = signer
        self._drops = drops
        self._limiter = RateLimiter(per_sender=PER_MAKER, total=TOTAL)

    def decline(self, demand: Verified[Demand], grounds: Grounds) -> None:
        """Say to the maker of a demand why this agent does not work for it."""
        if not self._limiter.allow(demand.signer):
            self._drops.count("declines", demand.signer)
            return
        order, code = demand.hash.hex(), grounds.code
        facts = log_event("demand-declined", order=order, maker=demand.signer, code=code)
        log.info("declined the demand %s of %s (%s): %s", order, demand.signer, code, grounds.detail, extra=facts)
        detail = grounds.detail[:LONGEST_DETAIL]
        decline = Decline(order=order, code=code, detail=detail, agent=self._signer.address)
        key = str(DeclineKey(self._channel.lighthouse, demand.signer))
        self._channel.put(key, decline.signed_by(self._signer).encode())
