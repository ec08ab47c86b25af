"""What came by while a market was watched, and what of it was not believed."""

from __future__ import annotations

from collections import Counter
from typing import TYPE_CHECKING

import msgspec

if TYPE_CHECKING:
    from collections.abc import Iterable

    from mesh.network import ValidationStatistics


class Tally(msgspec.Struct, frozen=True, kw_only=True):
    """What came in; what of it was refused, by reason; what was there already; what was lost to a slow reader."""

    received: int
    refused: dict[str, int]
    duplicate: int
    lost: int


def added_up(statistics: Iterable[ValidationStatistics]) -> Tally:
    """The sum of what came by several ways."""
    refused: Counter[str] = Counter()
    received = duplicate = lost = 0
    for one in statistics:
        refused.update(one.invalid)
        received, duplicate, lost = received + one.received, duplicate + one.duplicate, lost + one.dropped
    return Tally(received=received, refused=dict(refused), duplicate=duplicate, lost=lost)
