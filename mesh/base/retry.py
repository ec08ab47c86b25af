"""The retry policy: exponential backoff with jitter and a ceiling. Everything that tries again uses it."""

from __future__ import annotations

import random
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from mesh.errors import ConfigurationError

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable


@dataclass(frozen=True, slots=True, kw_only=True)
class RetryPolicy:
    """How long to wait between attempts, in seconds.

    The first delay is `initial`; each further one is `factor` times longer, up to `ceiling`. Up to `jitter` of a delay
    (0 to 1) is taken off at random, so that clients that failed together do not come back together. After `attempts`
    attempts in all (None: no limit) there is no further one.
    """

    initial: float = 1.0
    factor: float = 2.0
    ceiling: float = 60.0
    jitter: float = 0.25
    attempts: int | None = None

    def __post_init__(self) -> None:
        in_order = 0 <= self.initial <= self.ceiling and self.factor >= 1 and 0 <= self.jitter <= 1
        if not in_order or (self.attempts is not None and self.attempts < 1):
            raise ConfigurationError(f"not a retry policy: {self}")

    def delay(self, failures: int) -> float:
        """The longest delay after `failures` failures in a row, before jitter."""
        return min(self.initial * self.factor ** min(failures - 1, 64), self.ceiling)


REMOTE: Final = RetryPolicy(initial=0.5, ceiling=30.0)
"""For a node, a router or a daemon that does not answer: retries until it does."""


async def _sleep(seconds: float) -> None:
    import asyncio  # on first use: edge processes retry without an event loop

    await asyncio.sleep(seconds)


class Backoff:
    """The attempts at one thing: `next_delay` after each failure, `reset` after a success.

    `sleep` and `chance` (a float from 0 to 1) are injected by tests.
    """

    def __init__(
        self,
        policy: RetryPolicy = REMOTE,
        *,
        sleep: Callable[[float], Awaitable[None]] = _sleep,
        chance: Callable[[], float] = random.random,
    ) -> None:
        self._policy = policy
        self._sleep = sleep
        self._chance = chance
        self.failures = 0
        """Failures since the last success."""

    def next_delay(self) -> float | None:
        """Count a failure; the seconds to wait before the next attempt, None when there is none."""
        self.failures += 1
        if self._policy.attempts is not None and self.failures >= self._policy.attempts:
            return None
        return self._policy.delay(self.failures) * (1 - self._policy.jitter * self._chance())

    async def wait(self) -> bool:
        """Count a failure and wait for the next attempt; False at once when there is none."""
        delay = self.next_delay()
        if delay is None:
            return False
        await self._sleep(delay)
        return True

    def reset(self) -> None:
        """The last attempt succeeded."""
        self.failures = 0
