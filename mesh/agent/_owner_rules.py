"""What a robot works for, by its owner's settings: `queue_limit`, `least_price`, `accept…`, `refuse`, `hours`.

Some of them, its price, and whether it is paused, the owner may change while it runs; that is kept in the ledger.
Demands are checked before the handlers see them, and a demand that is refused is declined, like one that a handler
declines. An offer that answers no demand is open to everybody, and so is not checked.
"""

from __future__ import annotations

import asyncio
import re
import time
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Final

from msgspec.structs import replace

from mesh.agent.handlers import Declined
from mesh.agent.orders import ROBOT_STOPPED, robot_stopped
from mesh.amounts import InvalidAmount
from mesh.base.hours import Hours
from mesh.errors import ConfigurationError, InputError
from mesh.settings import MEANING
from schemas import parse_address
from schemas.allowed import read_topics
from schemas.decoding import decode_toml, text_of
from schemas.model import PRICE
from schemas.records import ControlRobot, RobotControl

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping

    from mesh.agent.components import AgentComponents
    from mesh.role.local_stop import Hold
    from schemas.allowed import AllowedTopics

PAUSED: Final = "paused"
QUEUE_FULL: Final = "queue-full"
OUTSIDE_HOURS: Final = "outside-hours"
FOR_NOW: Final = frozenset({QUEUE_FULL, OUTSIDE_HOURS, PAUSED, ROBOT_STOPPED})
"""The codes of refusals that end without a new demand: it is looked at again when it is sent again."""


class OwnerRules:
    """Whether an agent takes a job: `await rules.open()` once, then `rules.refusal(…)`.

    `jobs` counts the jobs that it has now: those that wait and run, and its offers that may become one. `price` is that
    of its model's description. Raises `ConfigurationError` for settings that can't be read.
    """

    def __init__(self, parts: AgentComponents, jobs: Callable[[], int], hold: Hold, *, price: str = "") -> None:
        settings = parts.settings
        self._parts = parts
        self._jobs = jobs
        self._hold = hold
        self._described = price
        self._limit = settings.queue_limit
        self._accepted = _addresses("accept", settings.accept)
        self._refused = _addresses("refuse", settings.refuse)
        self._hours = [_hours(text) for text in settings.hours]
        self._changed = ControlRobot()
        self._changing = asyncio.Lock()
        self._least: tuple[str, int, str] | None = None
        """The token (address) of the least price, that price in its smallest unit, and for people."""
        self._tokens: Mapping[str, str] | None = None
        """The tokens (addresses) that it is paid in, and their symbols; None until they are needed."""

    async def open(self) -> None:
        """Read what the owner has changed before. Raises `InputError` for prices that are none."""
        if self._described:
            await self._price_of(self._described)
        changed = await self._parts.ledger.control()
        self._use(changed, await self._least_of(changed))

    async def change(self, asked: ControlRobot) -> None:
        """Change what is given, for this run and later ones. Raises `InvalidAmount`, `InvalidAddress`."""
        async with self._changing:
            new = self._changed
            if asked.price is not None:
                new = replace(new, price=await self._price_of(asked.price) if asked.price else "")
            if asked.least_price is not None:
                least = await self._price_of(asked.least_price) if asked.least_price else ""
                new = replace(new, least_price=least)
            if asked.refuse is not None:
                new = replace(new, refuse=tuple(dict.fromkeys(map(parse_address, asked.refuse))))
            if asked.paused is not None:
                new = replace(new, paused=asked.paused)
            if new != self._changed:
                least_price = await self._least_of(new)
                await self._parts.ledger.keep_control(new)
                self._use(new, least_price)

    def _use(self, changed: ControlRobot, least: tuple[str, int, str] | None) -> None:
        self._changed, self._least, self._tokens = changed, least, None
        if changed.refuse is not None:
            self._refused = frozenset(changed.refuse)

    @property
    def price(self) -> str:
        """What a job usually costs (`5 XRT`); empty if nothing says so."""
        return self._changed.price or self._described

    @property
    def control(self) -> RobotControl:
        """What is in effect of that which the owner may change."""
        changed = self._changed
        least = self._parts.settings.least_price if changed.least_price is None else changed.least_price
        return RobotControl(
            price=self.price,
            paused=bool(changed.paused),
            refuse=tuple(sorted(self._refused)),
            least_price=least,
            held=self._hold.is_held,
        )

    async def refusal(self, customer: str, *, cost: int, token: str) -> Declined | None:
        """Why the agent does not work for a customer (address) for `cost` of a token (address), if it doesn't."""
        if customer in self._refused:
            return Declined("refused", "its owner does not work for this customer")
        if self._accepted and customer not in self._accepted:
            return Declined("not-accepted", "it works for certain customers only")
        if self._least is not None:
            wanted, price, shown = self._least
            if token != wanted or cost < price:
                return Declined("price-too-low", f"it works for at least {shown}")
        elif cost and token not in (paid_in := await self._paid_in()):  # in others a number has another worth
            return Declined("other-token", f"it is paid in {' or '.join(paid_in.values())}")
        return self.closed() or self.full()

    def closed(self) -> Declined | None:
        """Why the agent takes no jobs of anybody now, if it doesn't."""
        if (stopped := self.stopped()) is not None:
            return stopped
        if self._hours and not any(hours.contain(time.time()) for hours in self._hours):
            return Declined(OUTSIDE_HOURS, f"it works at {', '.join(self._parts.settings.hours)}")
        return None

    def stopped(self) -> Declined | None:
        """The refusal of each job until its owner releases the agent, or lets it take jobs again, if it is so."""
        if self._hold.is_held:
            return robot_stopped()
        return Declined(PAUSED, "its owner has paused it") if self._changed.paused else None

    def full(self) -> Declined | None:
        """The refusal of one more job now, if the agent was stopped or paused, or there is no place for it."""
        if self._limit and self._jobs() >= self._limit:
            return Declined(QUEUE_FULL, f"it has {self._limit} jobs, the most that it takes at a time")
        return self.stopped()

    async def _least_of(self, changed: ControlRobot) -> tuple[str, int, str] | None:
        chain, settings, outages = self._parts.chain, self._parts.settings, self._parts.outages
        text = settings.least_price if changed.least_price is None else changed.least_price
        if not text:
            return None
        amounts = partial(chain.tokens.amounts, text, default=settings.erc20_token)
        token, unit, (price,) = await chain.retrying(amounts, outages=outages)
        return token, price, unit.show(price)

    async def _paid_in(self) -> Mapping[str, str]:
        """The tokens that it is paid in where it has no least price: its own, and that of its price."""
        if self._tokens is None:
            self._tokens = await self._parts.chain.retrying(self._find_tokens, outages=self._parts.outages)
        return self._tokens

    async def _find_tokens(self) -> Mapping[str, str]:
        tokens, own = self._parts.chain.tokens, self._parts.settings.erc20_token
        found = {await tokens.address(own)}
        if self.price:
            found.add((await tokens.amounts(self.price, default=own)).token)
        return {token: unit.symbol for token, unit in (await tokens.units(found)).items()}

    async def _price_of(self, text: str) -> str:
        """A price that an owner has written, as profiles say it. Raises `InvalidAmount`, `ChainError`."""
        tokens = self._parts.chain.tokens
        token, unit, (amount,) = await tokens.amounts(text, default=self._parts.settings.erc20_token)
        price = tokens.price(amount, token, unit)
        if not re.fullmatch(PRICE, price):
            raise InvalidAmount(f"{text[:40]!r} is more than a price can be", hint=unit.hint())
        return price


def accepted_values(setting: str) -> AllowedTopics | None:
    """What the file of the setting `accept_values` allows; None without a file. Raises `ConfigurationError`."""
    if not setting:
        return None
    path = Path(setting).expanduser()
    try:
        return read_topics(decode_toml(text_of(path.read_bytes())))
    except OSError as error:
        raise _invalid("accept_values", setting, error.strerror or str(error)) from None
    except InputError as error:
        raise _invalid("accept_values", setting, str(error)) from None


def _hours(text: str) -> Hours:
    try:
        return Hours.parse(text)
    except ValueError as error:
        raise _invalid("hours", text, str(error)) from None


def _addresses(setting: str, texts: Iterable[str]) -> frozenset[str]:
    found = set()
    for text in texts:
        try:
            found.add(parse_address(text))
        except InputError as error:
            raise _invalid(setting, text, str(error)) from None
    return frozenset(found)


def _invalid(setting: str, text: str, why: str) -> ConfigurationError:
    why = f"the setting {setting} is invalid: {text[:80]!r}: {why}"
    return ConfigurationError(why, hint=f"{setting}: {MEANING[setting]}", code="invalid-option")
