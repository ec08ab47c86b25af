"""What a provider earns and spends."""

from __future__ import annotations

from collections import Counter, OrderedDict
from typing import TYPE_CHECKING, Final, NamedTuple

import msgspec

if TYPE_CHECKING:
    from mesh.chain import Created, Reverted, Settled

REASONS: Final = 64
"""Rejection reasons that are counted apart; further ones, which a stranger's contract may invent, count as `OTHER`."""
OTHER: Final = "Other"
REMEMBERED: Final = 4096
"""Liabilities whose entries can still be reverted; a reorganisation replaces only the last blocks."""
WN_DIGITS: Final = 9
WEI_DIGITS: Final = 18


class Earnings(msgspec.Struct, frozen=True, kw_only=True):
    """What a provider did so far, without what reorganisations reverted.

    Contracts created and finalized; messages rejected, by reason; gas used, and wei spent on it, including failed
    transactions; fees earned, and XRT minted for the gas (both wn).
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


class EarningsEntry(NamedTuple):
    """What one or more transactions changed; the fields are those of `Earnings`."""

    created: int = 0
    finalized: int = 0
    gas_used: int = 0
    spent: int = 0
    fees: int = 0
    minted: int = 0


class Turnover(NamedTuple):
    """Everything that was ever entered; it only grows. `matches` counts the matches found."""

    matches: int
    entered: EarningsEntry
    reverted: EarningsEntry
    """The part of it that reorganisations reverted."""


class EarningsLedger:
    """Adds up what one provider earns and spends."""

    def __init__(self) -> None:
        self._entered = EarningsEntry()
        self._reverted = EarningsEntry()
        self._matches = 0
        self._rejected: Counter[str] = Counter()
        self._created: OrderedDict[str, EarningsEntry] = OrderedDict()
        self._finalized: OrderedDict[str, EarningsEntry] = OrderedDict()

    def created(self, created: Created, *, fee: int) -> None:
        """A contract was created; its promisor paid `fee` (wn)."""
        entry = EarningsEntry(created=1, gas_used=created.gas_used, spent=created.wei, fees=fee)
        self._enter(self._created, created.liability, entry)

    def finalized(self, liability: str, settled: Settled) -> None:
        """The contract at the address `liability` was finalized."""
        entry = EarningsEntry(finalized=1, gas_used=settled.gas_used, spent=settled.wei, minted=settled.minted)
        self._enter(self._finalized, liability, entry)

    def failed(self, error: Reverted) -> None:
        """A transaction was reverted; it cost gas if it was mined."""
        self._entered = _sum(self._entered, EarningsEntry(gas_used=error.gas_used, spent=error.wei))

    def rejected(self, reason: str) -> None:
        """A message was rejected for this reason (a machine-readable word)."""
        known = reason in self._rejected or len(self._rejected) < REASONS
        self._rejected[reason if known else OTHER] += 1

    def matched(self) -> None:
        """A demand and an offer matched."""
        self._matches += 1

    def liability_reverted(self, liability: str) -> None:
        """A reorganisation reverted the creation of a contract."""
        self._take_off(self._created, liability)

    def finalization_reverted(self, liability: str) -> None:
        """A reorganisation reverted the finalization of a contract."""
        self._take_off(self._finalized, liability)

    def earnings(self) -> Earnings:
        """The sums now."""
        total = EarningsEntry(
            *(entered - reverted for entered, reverted in zip(self._entered, self._reverted, strict=True))
        )
        return Earnings(rejected=dict(self._rejected), **total._asdict())

    def turnover(self) -> Turnover:
        """Everything that was entered, and what of it was reverted."""
        return Turnover(self._matches, self._entered, self._reverted)

    def _enter(self, entries: OrderedDict[str, EarningsEntry], liability: str, entry: EarningsEntry) -> None:
        self._take_off(entries, liability)
        entries[liability] = entry
        self._entered = _sum(self._entered, entry)
        if len(entries) > REMEMBERED:
            entries.popitem(last=False)

    def _take_off(self, entries: OrderedDict[str, EarningsEntry], liability: str) -> None:
        self._reverted = _sum(self._reverted, entries.pop(liability, EarningsEntry()))


def _sum(total: EarningsEntry, more: EarningsEntry) -> EarningsEntry:
    return EarningsEntry(*(one + other for one, other in zip(total, more, strict=True)))


def _decimal(amount: int, digits: int) -> str:
    """An amount of the smallest unit as a decimal number, exactly."""
    whole, part = divmod(amount, 10**digits)
    return f"{whole:,}.{part:0{digits}}".rstrip("0").rstrip(".")
