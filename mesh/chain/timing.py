"""How long the chain's client waits, and how often it looks."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from mesh.errors import ConfigurationError
from mesh.retry import RetryPolicy

REORG_DEPTH: Final = 12
"""Blocks behind the head that are remembered by default; public chains reorganise one or two."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Timing:
    """Waiting times, in seconds where nothing else is said."""

    poll_interval: float = 1.0
    """Between two looks for a new block."""

    receipt_interval: float = 0.1
    """Between the first looks for a transaction's receipt; it grows up to `poll_interval`."""

    receipt_timeout: float = 180.0
    """Until a sent transaction is given up as not mined."""

    confirmations: int = 1
    """Blocks, not seconds: how many a transaction needs, its own included, to count as mined."""

    replace_after: float = 30.0
    """Until a transaction that is not mined is sent again with higher fees; and again after as long."""

    repeat_within: float = 600.0
    """How long after a transaction whose outcome was not learned sending the same again means that one, if mined."""

    request_timeout: float = 15.0
    """For one answer of the node."""

    attempts: int = 4
    """How often a request is made before the node counts as unreachable."""

    retry_delay: float = 0.25
    """Before the second attempt; doubled before each further one."""

    reorg_depth: int = REORG_DEPTH
    """Blocks, not seconds: how far behind the head a reader of events notices that blocks were replaced."""

    @property
    def outage_retry(self) -> RetryPolicy:
        """For a node that is gone for longer: from `poll_interval` to ten times as long, without end."""
        return RetryPolicy(initial=self.poll_interval, ceiling=10 * self.poll_interval)

    def __post_init__(self) -> None:
        intervals = (self.poll_interval, self.receipt_interval, self.replace_after)
        above_zero = (*intervals, self.receipt_timeout, self.request_timeout)
        counts, others = (self.attempts, self.confirmations, self.reorg_depth), (self.retry_delay, self.repeat_within)
        if min(counts) < 1 or min(above_zero) <= 0 or min(others) < 0:
            raise ConfigurationError(
                "intervals and timeouts are above zero, attempts and blocks one at least, and no time is negative"
            )
