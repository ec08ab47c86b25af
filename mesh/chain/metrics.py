"""What is measured of a chain: the transactions of this process, their cost, and how well the node answers."""

from __future__ import annotations

import asyncio
import logging
import time
from collections import Counter
from collections.abc import Mapping  # msgspec reads the annotations
from enum import StrEnum
from typing import TYPE_CHECKING, Final

import msgspec

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


class NodeStatistics(msgspec.Struct, frozen=True, kw_only=True):
    """Transactions by outcome, the gas that they used and what it cost (wei), and how well the node answers.

    `failures` are requests that no node answered in any attempt; `losses` is how often outages began.
    """

    transactions: Mapping[TransactionOutcome, int]
    gas_used: int
    wei: int
    failures: int
    losses: int


class NodeMetrics:
    """The counters of one node. Used by one event loop."""

    def __init__(self) -> None:
        self._transactions = Counter(dict.fromkeys(TransactionOutcome, 0))
        self._gas_used = 0
        self._wei = 0
        self._failures = 0
        self._losses = 0
        self._answers = True

    def count(self, outcome: TransactionOutcome) -> None:
        """Count the outcome of a transaction."""
        self._transactions[outcome] += 1

    def paid(self, *, gas_used: int, wei: int) -> None:
        """Add the cost of a mined transaction."""
        self._gas_used += gas_used
        self._wei += wei

    def answered(self) -> None:
        """Note that the node answered."""
        self._answers = True

    def failed(self) -> None:
        """Count a request that no attempt got answered."""
        self._failures += 1
        self._losses += self._answers
        self._answers = False

    def statistics(self) -> NodeStatistics:
        """The counters now."""
        return NodeStatistics(
            transactions=dict(self._transactions),
            gas_used=self._gas_used,
            wei=self._wei,
            failures=self._failures,
            losses=self._losses,
        )

    def families(self) -> tuple[MetricFamily, ...]:
        """The counters in Prometheus terms."""
        outcomes = {outcome.value: float(count) for outcome, count in self._transactions.items()}
        return (
            by_label(
                "aira_transactions_total",
                "counter",
                "Transactions of this account, by what became of them",
                "outcome",
                outcomes,
            ),
            counter("aira_gas_used_total", "Gas that transactions on the chain have used", self._gas_used),
            counter("aira_gas_spent_wei_total", "What that gas has cost, wei", self._wei),
            counter("aira_node_failures_total", "Questions that no node of the chain answered", self._failures),
            counter("aira_node_losses_total", "How often the nodes of the chain fell silent", self._losses),
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
