"""Orders for one robot alone: its offer is asked for first, then a provider gets the demand and the offer together.

A demand can't name who may do it, so it is not published. The robot decides on the demand without its signature, and
only providers with a stake ever see the signed pair: see "Orders for one robot" in docs/explanation/private-orders.md.
"""

from __future__ import annotations

import asyncio
import logging
from typing import TYPE_CHECKING, Final

from msgspec.structs import replace

from mesh.agent.orders import DEMAND_TAKEN
from mesh.base.log_context import log_event
from mesh.errors import AiraError, RemoteError, public_text
from mesh.network.services import call
from schemas import message_hash, verify_message
from schemas.messages import equal_terms
from schemas.rpc import AcceptDemand, Accepted, OrderPair, SendDemand, SendOffer, SendPermit
from schemas.signing import Decline, Rejection

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    import zenoh

    from mesh.agent.components import AgentComponents
    from mesh.base.background import Background
    from schemas import Demand, Offer, Verified
    from schemas.rpc import PairTaken

log = logging.getLogger(__name__)

PROVIDERS: Final = 32
"""Providers that get a pair, at most."""


class DemandDeclined(RemoteError, code="demand-declined"):
    """The robot that a demand is for, or all that are present, do not work for it: `declines` has the word of each.

    `order` is the demand's hash.
    """

    def __init__(self, order: str, declines: Sequence[Decline]) -> None:
        said = "; ".join(f"{one.agent}: {public_text(one.detail) or one.code} ({one.code})" for one in declines[:3])
        more = f"; and {len(declines) - 3} more" if len(declines) > 3 else ""
        super().__init__(
            f"declined by {said}{more}",
            hint="offer other terms, or ask another robot; `aira robots` shows who is present",
        )
        self.order = order
        self.declines = tuple(declines)


async def asked_offer(session: zenoh.Session, request: AcceptDemand) -> Accepted:
    """The robot's own offer for a demand that is for it alone, or its own refusal.

    Raises `InvalidMessage`, `ServiceFailed`, and `RemoteError` (`not-its-answer`) for what is neither.
    """
    demand, robot = request.demand.message(), request.robot
    # The robot may fetch the objective first.
    accepted: Accepted = await call(session, robot, "accept", request, timeout=30.0)
    match accepted:
        case Accepted(offer=SendOffer() as sent, decline=None):
            answer: Verified[Offer] = verify_message(sent.message())
            if answer.signer == robot and equal_terms(answer.message) == equal_terms(demand):
                return accepted
        case Accepted(offer=None, decline=Decline() as said):
            if said.agent == robot and said.order == message_hash(demand).hex() and said.is_signed:
                return accepted
    raise RemoteError(
        f"what answers for the robot {robot} is neither its offer nor its refusal",
        hint="somebody else answers on its key; a router with a roster prevents that",
        code="not-its-answer",
    )


async def send_pair(session: zenoh.Session, provider: str, pair: OrderPair) -> Rejection | None:
    """Send a pair to a provider (address); returns what it says against it, unsigned."""
    try:
        taken: PairTaken = await call(session, provider, "pair", pair)
        code, detail = taken.code, taken.detail
    except RemoteError as error:
        code, detail = error.code, "it does not answer, or takes no pairs"
    order = message_hash(pair.demand.message()).hex()
    return Rejection(order=order, reason=code, detail=detail, provider=provider) if code else None


class Hiring:
    """Sends the demands of an account that are for one robot alone, in `tasks`.

    `rejected` is called with what a provider says against a pair, `declined` with what the robot says.
    """

    def __init__(
        self,
        parts: AgentComponents,
        tasks: Background,
        *,
        rejected: Callable[[Rejection], object],
        declined: Callable[[Decline], object],
    ) -> None:
        self._parts = parts
        self._tasks = tasks
        self._rejected = rejected
        self._declined = declined
        self._under_way: set[str] = set()
        self._offers: dict[str, Offer] = {}
        """Offers that robots have just made, by the demand's hash."""

    async def agree(self, demand: Demand, robot: str) -> None:
        """Get the robot's offer for a demand that is sent next. Raises `DemandDeclined`, `RemoteError`."""
        self._offers[message_hash(demand).hex()] = await self._offer_of(demand, robot)

    def send(self, demand: Demand, robot: str) -> None:
        """Send a demand with the robot's offer to the providers, in a task, unless one does so already."""
        order = message_hash(demand).hex()
        if order not in self._under_way:
            self._under_way.add(order)
            task = self._tasks.start(self._send(order, demand, robot), f"pair {order}")
            task.add_done_callback(lambda _task: self._under_way.discard(order))

    async def _send(self, order: str, demand: Demand, robot: str) -> None:
        try:
            offer = self._offers.pop(order, None) or await self._offer_of(demand, robot)
            lighthouse = await self._parts.chain.lighthouses.get(self._parts.settings.lighthouse_contract)
            providers = [*lighthouse.stakes][:PROVIDERS]
            signer, session = self._parts.signer, self._parts.network.session
            permit = self._parts.chain.permits.own(demand.token)
            pair = OrderPair(
                demand=SendDemand.of(demand),
                offer=SendOffer.of(offer),
                maker=signer.address,
                permit=None if permit is None else SendPermit.of(permit),
            ).signed_by(signer)
            for rejection in await asyncio.gather(*(send_pair(session, provider, pair) for provider in providers)):
                if rejection is not None:
                    self._rejected(rejection)
        except DemandDeclined as error:
            if (said := error.declines[0]).code != DEMAND_TAKEN:  # else the chain soon shows the contract here, too
                self._declined(said)
        except AiraError as error:  # it is sent again
            facts = log_event("pair-not-sent", order=order, robot=robot, code=error.code)
            log.warning("the demand %s for %s can't be sent now: %s", order, robot, error, extra=facts)

    async def _offer_of(self, demand: Demand, robot: str) -> Offer:
        """The robot's offer for a demand, of which it gets no signature."""
        signer, order = self._parts.signer, message_hash(demand).hex()
        unsigned = SendDemand.of(replace(demand, signature=""))
        request = AcceptDemand(demand=unsigned, robot=robot, maker=signer.address).signed_by(signer)
        accepted = await asked_offer(self._parts.network.session, request)
        if accepted.decline is not None:
            raise DemandDeclined(order, (accepted.decline,))
        assert accepted.offer is not None
        offer: Offer = accepted.offer.message()
        return offer
