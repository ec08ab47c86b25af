"""What options are made of: the types of their values, and their meanings."""

from __future__ import annotations

from dataclasses import field
from typing import Annotated, Final, TypeVar

from msgspec import Meta

LONGEST: Final = 1e9
"""The most seconds that an option can hold, about thirty years: not every file format can express infinity."""

PositiveInt = Annotated[int, Meta(ge=1)]
NaturalInt = Annotated[int, Meta(ge=0)]
Seconds = Annotated[float, Meta(ge=0, le=LONGEST)]
Interval = Annotated[float, Meta(gt=0, le=LONGEST)]
SecondsOrEver = Annotated[float, Meta(ge=-1, le=LONGEST)]
Gwei = Annotated[float, Meta(ge=1e-9, le=1e9)]

Line = Annotated[str, Meta(max_length=80)]
Sentence = Annotated[str, Meta(max_length=200)]

T = TypeVar("T")


def option(default: T, meaning: str) -> T:
    """A field of a group: its default, and one line that explains it."""
    return field(default=default, metadata={"meaning": meaning})
