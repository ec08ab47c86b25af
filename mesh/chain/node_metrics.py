"""Counters of one node: the transactions of this process, their cost, and how well the node answers."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping  # msgspec reads the annotations
from enum import StrEnum

import msgspec


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
