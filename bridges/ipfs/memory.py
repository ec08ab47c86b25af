"""Which messages were seen on which side, so that none crosses twice. Pure."""

from __future__ import annotations

from collections import OrderedDict
from enum import Enum
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from collections.abc import Callable

LASTS: Final = 600.0
"""Seconds for which a crossing is remembered. After that a message that is sent again crosses again: whoever sends it
still waits for its effect, and a legacy peer that came meanwhile has never heard it."""
REMEMBERED: Final = 131_072
"""Messages remembered at most; the oldest go first."""


class Side(Enum):
    """Where a message was seen."""

    MESH = "mesh"
    IPFS = "ipfs"

    @property
    def other(self) -> Side:
        """The far side."""
        return Side.IPFS if self is Side.MESH else Side.MESH


class Memory:
    """What was seen in the last ten minutes. `clock` gives seconds since some moment."""

    def __init__(self, clock: Callable[[], float]) -> None:
        self._clock = clock
        self._seen: dict[Side, OrderedDict[bytes, float]] = {side: OrderedDict() for side in Side}

    def note(self, fingerprint: bytes, side: Side, *, age: float = 0.0) -> None:
        """The message is on that side, and has been for `age` seconds. Seeing it again makes it no younger."""
        seen = self._seen[side]
        if self.knows(fingerprint, side):
            return
        seen.pop(fingerprint, None)
        seen[fingerprint] = self._clock() - age
        if len(seen) > REMEMBERED:
            seen.popitem(last=False)

    def knows(self, fingerprint: bytes, side: Side) -> bool:
        """Whether the message was seen on that side."""
        seen = self._seen[side].get(fingerprint)
        return seen is not None and self._clock() - seen < LASTS

    def __len__(self) -> int:
        """How many are remembered, on the side with more."""
        return max(len(seen) for seen in self._seen.values())
