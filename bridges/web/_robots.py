"""What robots say of themselves, and what they ask for a job. All of it is their word."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Any, Final

import msgspec

from bridges.web.access import WebError
from mesh.agent.hiring import asked_offer
from mesh.base.flood import Rate, RateLimiter
from mesh.errors import public_text
from mesh.watching.quotes import QUOTE_TIMEOUT, asked_quotes
from schemas import InvalidAddress, InvalidMessage, parse_address

if TYPE_CHECKING:
    from bridges.web._market import Labels
    from bridges.web.components import WebComponents
    from mesh.watching import Robot
    from schemas.rpc import AcceptDemand, Accepted, Quote

QUESTIONS: Final = Rate(per_second=1.0, burst=16)
"""Questions for quotes or offers that one person may ask."""
LONGEST: Final = 200
"""Characters of why a robot declines."""


def profile_json(robot: Robot) -> dict[str, Any]:
    """How a robot presents itself, with neither its address nor what the chain says of it."""
    facts = msgspec.to_builtins(robot)
    return {name: facts[name] for name in facts if name not in ("address", "model", "paid", "refunded")}


class Questions:
    """Asks robots for quotes, as the server's `asker`, and for offers, as people sign that."""

    def __init__(self, components: WebComponents, labels: Labels) -> None:
        self._parts = components
        self._labels = labels
        self._limiter = RateLimiter(per_sender=QUESTIONS)
        self._asking = asyncio.Semaphore(8)  # questions for quotes that are open at a time
        self._asking_offers = asyncio.Semaphore(32)  # those for offers: a robot may take half a minute

    async def quotes(self, model: str, objective: str, *, sender: str) -> list[dict[str, Any]]:
        """What the robots of a model that are present want for an objective: the cheapest first, refusals last.

        Raises `WebError` if `sender` asks too often.
        """
        self._check(sender)
        parts = self._parts
        async with self._asking:
            robots = {one.address: one for one in await parts.robots.present(model, timeout=QUOTE_TIMEOUT)}
            quotes = await asked_quotes(
                parts.network.session,
                parts.channel,
                asker=parts.asker,
                robots=[*robots],
                model=model,
                objective=objective,
            )
            return [await self._json(quote, robots[quote.agent].name) for quote in quotes]

    async def offer(self, request: AcceptDemand, *, sender: str) -> Accepted:
        """The offer of a robot for a demand that is for it alone, or its refusal.

        Raises `InvalidMessage`, `RemoteError`, and `WebError` if `sender` asks too often.
        """
        self._check(sender)
        if not request.is_signed or request.demand.signature:
            raise InvalidMessage("signature", "the maker of the order signs the request, and not yet the order")
        parse_address(request.robot)
        async with self._asking_offers:
            return await asked_offer(self._parts.network.session, request)

    def _check(self, sender: str) -> None:
        if not self._limiter.allow(sender):
            raise WebError("too many questions to robots", hint="wait a moment", code="too-many-requests")

    async def _json(self, quote: Quote, name: str) -> dict[str, Any]:
        token, validator = _address(quote.token), _address(quote.validator)
        code, detail = quote.code, quote.detail
        if not code and not token:
            code, detail = "unknown-token", "it does not say in which token"
        return {
            "agent": quote.agent,
            "name": name,
            "cost": str(int(quote.cost)),
            "token": await self._labels.learn(token or self._parts.token),
            "validator": validator,
            "start": quote.start,
            "seconds": quote.seconds,
            "until": quote.until,
            "code": public_text(code, longest=64),
            "detail": public_text(detail, longest=LONGEST),
        }


def _address(text: str) -> str:
    """The address (EIP-55) in a text of a stranger; empty if there is none."""
    try:
        return parse_address(text)
    except InvalidAddress:
        return ""
