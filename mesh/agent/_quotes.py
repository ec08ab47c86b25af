"""The quotes of a robot: what it asks for a job, and when it would do it. They bind nobody, and cost nothing.

It answers with what its handler says, or by default with its price: the one that its owner has set, or that of its
model's description.
"""

from __future__ import annotations

import logging
from functools import partial
from typing import TYPE_CHECKING, Final

from mesh.agent.demands import grounds_of
from mesh.agent.errors import Declined
from mesh.agent.handlers import call_handler
from mesh.agent.objectives import Buyer
from mesh.agent.orders import FEWEST_BLOCKS, HANDLED_FOR
from mesh.base.flood import Rate, RateLimiter
from mesh.base.log_context import log_event
from mesh.errors import AiraError, InvalidMessage, public_text
from schemas.cid import is_cid
from schemas.rpc import Quote
from schemas.signing import LONGEST_DETAIL

if TYPE_CHECKING:
    from collections.abc import Sequence

    from mesh.agent._owner_rules import OwnerRules
    from mesh.agent._profile import OwnProfile
    from mesh.agent.components import AgentComponents
    from mesh.agent.handlers import QuoteHandler
    from mesh.agent.objectives import Objectives
    from schemas.model import ModelDescription
    from schemas.rpc import QuoteRequest

log = logging.getLogger(__name__)

PER_ASKER: Final = Rate(per_second=1.0, burst=32)
"""Quotes for one asker …"""
TOTAL: Final = Rate(per_second=10.0, burst=200)
"""… and for all."""


class Quoting:
    """The service `quote` of a robot: what its handler asks for a job, or its usual price.

    What its owner's `rules` exclude is declined.
    """

    def __init__(
        self,
        parts: AgentComponents,
        profile: OwnProfile,
        rules: OwnerRules,
        objectives: Objectives,
        handlers: Sequence[QuoteHandler],
        description: ModelDescription | None,
        *,
        model: str,
    ) -> None:
        self._parts = parts
        self._profile = profile
        self._rules = rules
        self._objectives = objectives
        self._handlers = handlers
        self._seconds = float((None if description is None else description.seconds) or 0)
        self._model = model
        self._limiter = RateLimiter(per_sender=PER_ASKER, total=TOTAL)

    async def quote(self, request: QuoteRequest) -> Quote:
        """The signed reply. Raises `InvalidMessage` for a request that is not signed, or for another market."""
        if not request.is_signed:
            raise InvalidMessage("signature", "the request is not signed by its asker")
        if request.lighthouse != self._parts.channel.lighthouse:
            raise InvalidMessage("lighthouse", f"made for {request.lighthouse}, not for this market")
        agent, identity = self._parts.signer.address, request.identity
        try:
            quote = await self._quote(request)
        except AiraError as error:
            grounds = grounds_of(error)
            code, detail = ("failed", "its handler failed") if grounds is None else grounds
            if grounds is None:
                log.warning("no quote: %s", error, extra=log_event("quote-failed", code=error.code))
            detail = public_text(detail, longest=LONGEST_DETAIL)
            quote = Quote(agent=agent, request=identity, code=code, detail=detail)
        return quote.signed_by(self._parts.signer)

    async def _quote(self, request: QuoteRequest) -> Quote:
        parts = self._parts
        if not self._limiter.allow(request.asker):
            raise Declined("busy", "too many ask")
        if (closed := self._rules.closed()) is not None:
            raise closed
        if is_cid(self._model) and request.model != self._model:
            raise Declined("other-model", f"it works for the model {self._model}")
        price: int | str | None = self._rules.price or None
        HANDLED_FOR.set(buyer := Buyer(request.asker, pays=False))
        if (excluded := await self._objectives.refusal(request.objective, buyer)) is not None:
            raise excluded
        for handler in self._handlers:
            price = await call_handler(handler, request)
        if price is None:
            raise Declined("no-price", "it names no price; its answer to a demand says whether that is enough")
        amounts = partial(parts.chain.tokens.amounts, price, default=parts.settings.erc20_token)
        paid_in, _, (cost,) = await parts.chain.retrying(amounts, outages=parts.outages)
        if (refused := await self._rules.refusal(request.asker, cost=cost, token=paid_in)) is not None:
            raise refused
        _, wait = await self._profile.queue()
        return Quote(
            agent=parts.signer.address,
            request=request.identity,
            cost=cost,
            token=paid_in,
            start=float(wait),
            seconds=self._seconds,
            until=parts.chain_head.contract_block + FEWEST_BLOCKS,
        )
