"""What is measured of a chain: the transactions of this process, their cost, and how well the node answers."""

from __future__ import annotations

import asyncio
import logging
import time
from collections import Counter
from enum import StrEnum
from typing import TYPE_CHECKING, Final

from mesh.errors import AiraError
from mesh.telemetry.metrics import MetricFamily, by_label, counter, gauge

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Iterable

log = logging.getLogger(__name__)

ASK_TIMEOUT: Final = 1.0
"""Seconds that the node may take; metrics that it does not answer by then are left out."""


class TransactionOutcome(StrEnum):
    """The outcome of a transaction. A transaction that is mined was also sent, and counts as both."""

    SENT = "sent"
    """Given to the node for the first time."""
    REPLACED = "replaced"
    """Replaced by one with higher fees because it was stuck."""
    MINED = "mined"
    """Mined, and successful."""
    FAILED = "failed"
    """Mined and paid for, but reverted."""
    REFUSED = "refused"
    """Never sent, because the contracts would revert it."""
    LOST = "lost"
    """Another transaction was mined with its nonce."""


class NodeMetrics:
    """The counters of one node: transactions by outcome, their cost, and how well the node answers."""

    def __init__(self) -> None:
        self.transactions = Counter(dict.fromkeys(TransactionOutcome, 0))
        self.gas_used = 0
        self.wei = 0
        """What they have cost."""
        self.data_wei = 0
        """The part of it that an OP-type rollup has charged for their data."""
        self.failures = 0
        """Requests that no node answered in any attempt."""
        self.losses = 0
        """How often outages began."""
        self._answers = True

    def count(self, *, answered: bool) -> None:
        """Count a request, which was answered in some attempt or in none."""
        if not answered:
            self.failures += 1
            self.losses += self._answers
        self._answers = answered

    def families(self) -> tuple[MetricFamily, ...]:
        """The counters in Prometheus terms."""
        outcomes = {outcome.value: float(count) for outcome, count in self.transactions.items()}
        meaning = "Transactions of this account, by what became of them"
        return (
            by_label("aira_transactions_total", "counter", meaning, "outcome", outcomes),
            counter("aira_gas_used_total", "Gas that transactions on the chain have used", self.gas_used),
            counter("aira_gas_spent_wei_total", "What these transactions have cost, wei", self.wei),
            counter("aira_data_spent_wei_total", "The part of it for their data, on OP-type rollups", self.data_wei),
            counter("aira_node_failures_total", "Questions that no node of the chain answered", self.failures),
            counter("aira_node_losses_total", "How often the nodes of the chain fell silent", self.losses),
        )


class CachedMetrics:
    """Metrics that the node is asked for at most every `max_age` seconds, left out if it does not answer in time."""

    def __init__(self, ask: Callable[[], Awaitable[Iterable[MetricFamily]]], *, max_age: float) -> None:
        self._ask = ask
        self._max_age = max_age
        self._families: tuple[MetricFamily, ...] = ()
        self._asked_at = float("-inf")

    async def measure(self) -> tuple[MetricFamily, ...]:
        """The metrics, not older than `max_age`."""
        if time.monotonic() - self._asked_at >= self._max_age:
            self._asked_at = time.monotonic()
            try:
                async with asyncio.timeout(ASK_TIMEOUT):
                    self._families = tuple(await self._ask())
            except (AiraError, TimeoutError) as error:
                log.debug("metrics of the chain are left out: %s", error)
                self._families = ()
        return self._families


def reading_families(*, head: int, read_at: float) -> tuple[MetricFamily, ...]:
    """How far the chain was read: up to the block `head`, at the time `read_at` of the monotonic clock."""
    return (
        gauge("aira_chain_head_block", "The last block that was read", head),
        gauge("aira_chain_read_age_seconds", "Seconds since a block was read", time.monotonic() - read_at),
    )
