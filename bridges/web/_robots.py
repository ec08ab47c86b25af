"""What robots say of themselves, and what they ask for a job: all of it is their word. And which of them are away."""

from __future__ import annotations

import asyncio
import time
from typing import TYPE_CHECKING, Any, Final

import msgspec

from bridges.web._access import WebError
from mesh.agent.hiring import asked_offer
from mesh.base.flood import BoundedDict, Rate, RateLimiter
from mesh.errors import public_text
from mesh.watching.robots import QUOTE_TIMEOUT, asked_quotes
from schemas import InvalidAddress, InvalidMessage, parse_address

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable

    from bridges.web._market import Labels, Market
    from bridges.web.components import WebComponents
    from mesh.watching import Robot
    from schemas.rpc import AcceptDemand, Accepted, Quote

QUESTIONS: Final = Rate(per_second=1.0, burst=16)
"""Questions for quotes or offers that one person may ask."""
LONGEST: Final = 200
"""Characters of why a robot declines."""
AWAY: Final = 32
"""Robots that are listed as away: those that have had jobs, then those that were here last, …"""
AWAY_SECONDS: Final = 30 * 86_400.0
"""… and for how long."""
REMEMBERED: Final = 256
"""Robots of which it is remembered how they presented themselves."""


def profile_json(robot: Robot) -> dict[str, Any]:
    """How a robot presents itself, with neither its address nor what the chain says of it."""
    facts = msgspec.to_builtins(robot)
    return {name: facts[name] for name in facts if name not in ("address", "model", "paid", "refunded")}


class LastSeen:
    """Robots that were here: how each presented itself last, and when; and when those were last heard that have had
    jobs."""

    def __init__(self, components: WebComponents, market: Market) -> None:
        self._parts = components
        self._market = market
        self._robots: BoundedDict[str, tuple[Robot, float]] = BoundedDict(REMEMBERED)

    def saw(self, robots: Iterable[Robot]) -> None:
        """These robots are here now."""
        for robot in robots:
            self._robots[robot.address] = robot, time.time()

    async def away(self, present: Collection[str]) -> dict[str, tuple[Robot | None, float]]:
        """The robots (addresses) that are not `present`: their profiles, if known, and since when they are away."""
        jobs = await self._last_jobs(present)
        found: dict[str, tuple[Robot | None, float]] = {address: (None, at) for address, at in jobs.items()}
        for address, (robot, at) in self._robots.items():
            if address not in present:
                found[address] = robot, max(at, jobs.get(address, 0.0))
        oldest = time.time() - AWAY_SECONDS
        recent = [address for address, (_, since) in found.items() if since > oldest]
        recent.sort(key=lambda address: (address in jobs, found[address][1]), reverse=True)
        return {address: found[address] for address in recent[:AWAY]}

    async def _last_jobs(self, present: Collection[str]) -> dict[str, float]:
        """When the latest job of each robot that is not `present` took its last step."""
        steps: dict[str, dict[str, Any]] = {}
        for job in reversed(self._market.jobs.values()):
            robot, is_ours = job.liability.promisor, job.liability.lighthouse == self._parts.lighthouse
            if is_ours and job.steps and robot not in present and len(steps) < AWAY:
                steps.setdefault(robot, job.steps[-1])
        times = [step["at"] or await self._market.time_of(step["block"] or 0) or 0.0 for step in steps.values()]
        return dict(zip(steps, times, strict=True))


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
