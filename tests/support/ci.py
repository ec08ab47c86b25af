"""Whether CI runs the tests: it runs all of them, each with every implementation, and more random cases."""

from __future__ import annotations

import os
import random
from typing import Final

IN_CI: Final = os.environ.get("CI") == "true"
EXAMPLES: Final = 100 if IN_CI else 25
"""Of a property test."""


def seed_of_part(first: int) -> int:
    """The seed of a part of a test's random cases, by the number of its first one.

    In CI Hypothesis makes the same cases up in each run: without a seed, each part would have the same ones, too.
    """
    return first if IN_CI else random.getrandbits(64)
