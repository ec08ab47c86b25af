"""Which faults happen: by chance of their own, numbered, so that a history can be played again without some of them."""

from __future__ import annotations

import random
from collections import Counter


class FaultDraw:
    """Decides of each fault whether it happens, and counts by kind those that do.

    Chance is its own: what the market does does not change it. Each fault that happens has a number, from 0;
    `left_out` are the numbers of those that do not happen after all.
    """

    def __init__(self, seed: object = 0, left_out: frozenset[int] = frozenset()) -> None:
        self.random = random.Random(f"faults {seed}")
        self.counts: Counter[str] = Counter()
        self.drawn = 0
        self._left_out = left_out

    def __call__(self, kind: str, probability: float = 1.0) -> bool:
        """Whether a fault of a kind happens now."""
        if not probability or self.random.random() >= probability:
            return False
        number, self.drawn = self.drawn, self.drawn + 1
        if number in self._left_out:
            return False
        self.counts[kind] += 1
        return True
