"""What a robot works for, by the settings of its owner: `queue_limit`, `least_price`, `accept`, `refuse`, `hours`.

Demands are checked before the handlers see them, and a demand that is refused is declined, like one that a handler
declines. An offer that answers no demand is open to everybody, and so is not checked.
"""

from __future__ import annotations

import re
import time
from dataclasses import dataclass
from datetime import datetime, tzinfo
from functools import partial
from typing import TYPE_CHECKING, Final
from zoneinfo import ZoneInfo, ZoneInfoNotFoundError

from mesh.agent.errors import Declined
from mesh.errors import ConfigurationError, InputError
from mesh.settings import MEANING
from schemas import parse_address

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from mesh.agent.components import AgentComponents

QUEUE_FULL: Final = "queue-full"
OUTSIDE_HOURS: Final = "outside-hours"
FOR_NOW: Final = frozenset({QUEUE_FULL, OUTSIDE_HOURS})
"""The codes of refusals that end by themselves: the demand is looked at again when it is sent again."""

DAYS: Final = ("mon", "tue", "wed", "thu", "fri", "sat", "sun")
_HOURS: Final = re.compile(
    r"(?:(?P<first>[a-z]{3})(?:-(?P<last>[a-z]{3}))? )?(?P<begin>\d\d:\d\d)-(?P<end>\d\d:\d\d)(?: (?P<zone>\S+))?",
    re.IGNORECASE,
)
_DAY: Final = 24 * 60
"""Minutes."""


@dataclass(frozen=True, slots=True)
class Hours:
    """Some hours of some days of the week. Hours that end before they begin end on the next day."""

    days: frozenset[int]
    """Of the begin; 0 is Monday."""
    begin: int
    """Minutes after midnight, as `end`."""
    end: int
    zone: tzinfo | None
    """None: the machine's."""

    @classmethod
    def parse(cls, text: str) -> Hours:
        """The hours in `Mon-Fri 08:00-18:00 Europe/Berlin`; days and zone may be left out. Raises `ValueError`."""
        found = _HOURS.fullmatch(" ".join(text.split()))
        if found is None:
            raise ValueError("it is not like 'Mon-Fri 08:00-18:00 Europe/Berlin'")
        begin, end = _minutes(found["begin"]), _minutes(found["end"])
        if begin == end:
            raise ValueError("it ends when it begins; 00:00-24:00 is the whole day")
        try:
            first = DAYS.index((found["first"] or "mon").lower())
            last = DAYS.index((found["last"] or found["first"] or "sun").lower())
        except ValueError:
            raise ValueError("a day is one of Mon, Tue, Wed, Thu, Fri, Sat and Sun") from None
        try:
            zone = ZoneInfo(found["zone"]) if found["zone"] else None
        except (ZoneInfoNotFoundError, ValueError):
            raise ValueError(f"this machine knows no time zone {found['zone']}") from None
        days = frozenset((first + number) % 7 for number in range((last - first) % 7 + 1))
        return cls(days, begin, end, zone)

    def contain(self, now: float) -> bool:
        """Whether a Unix time is in these hours."""
        local = datetime.fromtimestamp(now, self.zone)
        day, minute = local.weekday(), local.hour * 60 + local.minute
        if self.begin < self.end:
            return day in self.days and self.begin <= minute < self.end
        return (day in self.days and minute >= self.begin) or ((day - 1) % 7 in self.days and minute < self.end)


class OwnerRules:
    """Whether an agent takes a job, by its settings: `await rules.refusal(…)`.

    `jobs` counts the jobs that it has now: those that wait and run, and its offers that may become one. Raises
    `ConfigurationError` for settings that can't be read.
    """

    def __init__(
        self, parts: AgentComponents, jobs: Callable[[], int], *, clock: Callable[[], float] = time.time
    ) -> None:
        settings = parts.settings
        self._parts = parts
        self._jobs = jobs
        self._clock = clock
        self._limit = settings.queue_limit
        self._accepted = _addresses("accept", settings.accept)
        self._refused = _addresses("refuse", settings.refuse)
        self._hours = [_hours(text) for text in settings.hours]
        self._least: tuple[str, int, str] | None = None
        """The token (address) of `least_price`, that price in its smallest unit, and for people."""

    async def refusal(self, customer: str, *, cost: int, token: str) -> Declined | None:
        """Why the agent does not work for a customer (address) for `cost` of a token (address), if it doesn't."""
        if customer in self._refused:
            return Declined("refused", "its owner does not work for this customer")
        if self._accepted and customer not in self._accepted:
            return Declined("not-accepted", "it works for certain customers only")
        await self.open()
        if self._least is not None:
            wanted, price, shown = self._least
            if token != wanted or cost < price:
                return Declined("price-too-low", f"it works for at least {shown}")
        if not self.is_open:
            return Declined(OUTSIDE_HOURS, f"it works at {', '.join(self._parts.settings.hours)}")
        return self.full()

    @property
    def is_open(self) -> bool:
        """Whether it is one of the hours at which the agent takes jobs."""
        return not self._hours or any(hours.contain(self._clock()) for hours in self._hours)

    def full(self) -> Declined | None:
        """The refusal of one more job, if there is no place for it."""
        if self._limit and self._jobs() >= self._limit:
            return Declined(QUEUE_FULL, f"it has {self._limit} jobs, the most that it takes at a time")
        return None

    async def open(self) -> None:
        """Read `least_price`. Raises `InvalidAmount` if it is not an amount of the token."""
        chain, settings, outages = self._parts.chain, self._parts.settings, self._parts.outages
        if settings.least_price and self._least is None:
            token = await chain.retrying(partial(chain.names.address, settings.erc20_token), outages=outages)
            unit = await chain.retrying(partial(chain.tokens.unit, token), outages=outages)
            price = unit.parse(settings.least_price)
            self._least = token, price, unit.show(price)


def _minutes(text: str) -> int:
    hours, minutes = map(int, text.split(":"))
    if minutes > 59 or hours * 60 + minutes > _DAY:
        raise ValueError(f"{text} is not a time of the day")
    return hours * 60 + minutes


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
