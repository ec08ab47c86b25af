"""The retry policy: how long each wait is, and when there is no further attempt."""

from __future__ import annotations

import pytest

from mesh.base.retry import Backoff, RetryPolicy
from mesh.errors import ConfigurationError


def waits(policy: RetryPolicy, count: int, *, chance: float = 0.0) -> list[float | None]:
    backoff = Backoff(policy, chance=lambda: chance)
    return [backoff.next_delay() for _ in range(count)]


def test_delays_grow_to_the_ceiling() -> None:
    assert waits(RetryPolicy(initial=1.0, factor=2.0, ceiling=5.0), 5) == [1.0, 2.0, 4.0, 5.0, 5.0]


def test_jitter_only_shortens_a_delay() -> None:
    policy = RetryPolicy(initial=2.0, ceiling=8.0, jitter=0.25)

    assert waits(policy, 3, chance=1.0) == [1.5, 3.0, 6.0]


def test_after_the_last_attempt_there_is_no_delay() -> None:
    assert waits(RetryPolicy(initial=1.0, attempts=3), 4) == [1.0, 2.0, None, None]


def test_a_thousand_failures_do_not_overflow() -> None:
    assert waits(RetryPolicy(initial=1.0, ceiling=60.0), 2_000)[-1] == 60.0


async def test_wait_sleeps_and_a_success_starts_over() -> None:
    slept: list[float] = []

    async def sleep(seconds: float) -> None:
        slept.append(seconds)

    backoff = Backoff(RetryPolicy(initial=1.0, attempts=3), sleep=sleep, chance=lambda: 0.0)
    assert await backoff.wait()
    backoff.reset()
    assert await backoff.wait()
    assert await backoff.wait()
    assert not await backoff.wait()

    assert slept == [1.0, 1.0, 2.0]


@pytest.mark.parametrize(
    "options", [{"initial": -1.0}, {"initial": 2.0, "ceiling": 1.0}, {"factor": 0.5}, {"jitter": 1.5}, {"attempts": 0}]
)
def test_an_invalid_policy_is_refused(options: dict[str, float]) -> None:
    with pytest.raises(ConfigurationError):
        RetryPolicy(**options)  # type: ignore[arg-type]
