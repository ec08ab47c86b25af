"""What a provider's work brings in, and what it costs."""

from __future__ import annotations

from collections import Counter, OrderedDict
from typing import TYPE_CHECKING, Final, NamedTuple

import msgspec

if TYPE_CHECKING:
    from mesh.chain import Created, Reverted, Settled

REASONS: Final = 64
"""Reasons of rejections that are told apart at most: a stranger's contract may make up any number of them."""
OTHER: Final = "Other"
REMEMBERED: Final = 4096
"""Transactions that can still be taken back; the chain replaces its last blocks only."""
WN_DIGITS: Final = 9
WEI_DIGITS: Final = 18


class Earnings(msgspec.Struct, frozen=True, kw_only=True):
    """What a provider did so far; what the chain took back again does not count.

    Contracts made and finalized, messages rejected by reason; gas, and the wei paid for it, also for what failed;
    fees, and XRT minted for the gas (both wn).
    """

    created: int
    finalized: int
    rejected: dict[str, int]
    gas_used: int
    spent: int
    fees: int
    minted: int

    def __str__(self) -> str:
        rejected = sum(self.rejected.values())
        return (
            f"contracts: {self.created} made, {self.finalized} finalized; messages rejected: {rejected}; "
            f"earned {_decimal(self.fees + self.minted, WN_DIGITS)} XRT ({_decimal(self.fees, WN_DIGITS)} in fees, "
            f"{_decimal(self.minted, WN_DIGITS)} minted for gas), "
            f"spent {_decimal(self.spent, WEI_DIGITS)} ETH on {self.gas_used:,} gas"
        )


class Entry(NamedTuple):
    """What one transaction changed, or several together. Named as the fields of `Earnings`."""

    created: int = 0
    finalized: int = 0
    gas_used: int = 0
    spent: int = 0
    fees: int = 0
    minted: int = 0


class Turnover(NamedTuple):
    """All that was ever entered: it only grows. `matches` are the pairs that were to become contracts."""

    matches: int
    entered: Entry
    taken_back: Entry
    """What of it the chain took back again."""


class EarningsLedger:
    """The account of one provider."""

    def __init__(self) -> None:
        self._entered = Entry()
        self._taken_back = Entry()
        self._matches = 0
        self._rejected: Counter[str] = Counter()
        self._made: OrderedDict[str, Entry] = OrderedDict()
        self._ended: OrderedDict[str, Entry] = OrderedDict()

    def made(self, created: Created, *, fee: int) -> None:
        """A contract was made, for which its promisor paid `fee` (wn)."""
        entry = Entry(created=1, gas_used=created.gas_used, spent=created.wei, fees=fee)
        self._enter(self._made, created.liability, entry)

    def ended(self, liability: str, settled: Settled) -> None:
        """The contract at the address `liability` was finalized."""
        entry = Entry(finalized=1, gas_used=settled.gas_used, spent=settled.wei, minted=settled.minted)
        self._enter(self._ended, liability, entry)

    def failed(self, error: Reverted) -> None:
        """A transaction was refused; it has cost something if it was mined."""
        self._entered = _sum(self._entered, Entry(gas_used=error.gas_used, spent=error.wei))

    def rejected(self, reason: str) -> None:
        """A message can't be used, for this reason (a machine-readable word)."""
        known = reason in self._rejected or len(self._rejected) < REASONS
        self._rejected[reason if known else OTHER] += 1

    def matched(self) -> None:
        """A demand and an offer agree."""
        self._matches += 1

    def unmade(self, liability: str) -> None:
        """The chain took back that the contract was made."""
        self._strike(self._made, liability)

    def unended(self, liability: str) -> None:
        """The chain took back that the contract was finalized."""
        self._strike(self._ended, liability)

    def earnings(self) -> Earnings:
        """The account as it stands."""
        total = Entry(*(entered - undone for entered, undone in zip(self._entered, self._taken_back, strict=True)))
        return Earnings(rejected=dict(self._rejected), **total._asdict())

    def turnover(self) -> Turnover:
        """What the account has seen."""
        return Turnover(self._matches, self._entered, self._taken_back)

    def _enter(self, page: OrderedDict[str, Entry], liability: str, entry: Entry) -> None:
        self._strike(page, liability)
        page[liability] = entry
        self._entered = _sum(self._entered, entry)
        if len(page) > REMEMBERED:
            page.popitem(last=False)

    def _strike(self, page: OrderedDict[str, Entry], liability: str) -> None:
        self._taken_back = _sum(self._taken_back, page.pop(liability, Entry()))


def _sum(total: Entry, more: Entry) -> Entry:
    return Entry(*(one + other for one, other in zip(total, more, strict=True)))


def _decimal(amount: int, digits: int) -> str:
    """An amount of the smallest unit as people write it, exactly."""
    whole, part = divmod(amount, 10**digits)
    return f"{whole:,}.{part:0{digits}}".rstrip("0").rstrip(".")
