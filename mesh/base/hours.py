"""Hours of the week, as people write them: `Mon-Fri 08:00-18:00 Europe/Berlin`."""

from __future__ import annotations

import re
from dataclasses import dataclass
from datetime import datetime, tzinfo
from typing import Final
from zoneinfo import ZoneInfo, ZoneInfoNotFoundError

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


def _minutes(text: str) -> int:
    hours, minutes = map(int, text.split(":"))
    if minutes > 59 or hours * 60 + minutes > _DAY:
        raise ValueError(f"{text} is not a time of the day")
    return hours * 60 + minutes
