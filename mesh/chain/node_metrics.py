"""What one node has done for its accounts in this process, counted: figures for an operator."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping  # msgspec reads the annotations
from enum import StrEnum

import msgspec


class TransactionOutcome(StrEnum):
    """What became of a transaction, or of the wish to send one. Who is mined was sent before, and counts as both."""

    SENT = "sent"
    """Given to the node for the first time."""
    REPLACED = "replaced"
    """Made dearer, as it was stuck."""
    MINED = "mined"
    """It is on the chain, and went through."""
    FAILED = "failed"
    """It is on the chain and paid for, and was refused there."""
    REFUSED = "refused"
    """The contracts would refuse it, so it was never sent."""
    LOST = "lost"
    """Another one was mined with its number."""


class NodeStatistics(msgspec.Struct, frozen=True, kw_only=True):
    """A node's transactions by fate, the gas that they used and what it cost (wei), and how well the node answers.

    `failures` are questions that no node answered, all attempts together; `losses` how often it fell silent.
    """

    transactions: Mapping[TransactionOutcome, int]
    gas_used: int
    wei: int
    failures: int
    losses: int


class NodeMetrics:
    """Counts for one node. Used by one event loop."""

    def __init__(self) -> None:
        self._transactions = Counter(dict.fromkeys(TransactionOutcome, 0))
        self._gas_used = 0
        self._wei = 0
        self._failures = 0
        self._losses = 0
        self._answers = True

    def count(self, fate: TransactionOutcome) -> None:
        """This became of a transaction."""
        self._transactions[fate] += 1

    def paid(self, *, gas_used: int, wei: int) -> None:
        """A transaction that is on the chain has cost this."""
        self._gas_used += gas_used
        self._wei += wei

    def answered(self) -> None:
        """The node has answered."""
        self._answers = True

    def failed(self) -> None:
        """The node has not answered, however often it was asked."""
        self._failures += 1
        self._losses += self._answers
        self._answers = False

    def statistics(self) -> NodeStatistics:
        """The counts now."""
        return NodeStatistics(
            transactions=dict(self._transactions),
            gas_used=self._gas_used,
            wei=self._wei,
            failures=self._failures,
            losses=self._losses,
        )
