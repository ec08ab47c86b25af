"""What a provider earns and spends."""

from __future__ import annotations

import logging
from collections import Counter, OrderedDict
from typing import TYPE_CHECKING, Final, NamedTuple

import msgspec

from mesh.log_context import liability_context, log_event

if TYPE_CHECKING:
    from mesh.chain import Created, Reverted, Settled

log = logging.getLogger(__name__)

REASONS: Final = 64
"""Rejection reasons that are counted apart; further ones, which a stranger's contract may invent, count as `OTHER`."""
OTHER: Final = "Other"
REMEMBERED: Final = 4096
"""Transactions whose entries can still be reverted, or come back; a reorganisation replaces only the last blocks."""
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
        self._mined: OrderedDict[str, EarningsEntry] = OrderedDict()
        self._gone: OrderedDict[str, EarningsEntry] = OrderedDict()

    def created(self, created: Created, *, fee: int) -> None:
        """A contract was created; its promisor paid `fee` (wn)."""
        entry = EarningsEntry(created=1, gas_used=created.gas_used, spent=created.wei, fees=fee)
        self._enter(created.tx, entry)

    def finalized(self, settled: Settled) -> None:
        """A contract was finalized."""
        entry = EarningsEntry(finalized=1, gas_used=settled.gas_used, spent=settled.wei, minted=settled.minted)
        self._enter(settled.tx, entry)

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

    def creation_reverted(self, liability: str, tx: str) -> None:
        """A reorganisation reverted the transaction that created a liability."""
        with liability_context(liability):
            log.warning("a reorganisation reverted the contract", extra=log_event("contract-reverted"))
        self.reverted(tx)

    def reverted(self, tx: str) -> None:
        """A reorganisation reverted a transaction, perhaps not ours."""
        if (entry := self._mined.pop(tx, None)) is not None:
            self._reverted = _sum(self._reverted, entry)
            _keep(self._gone, tx, entry)

    def mined(self, tx: str) -> None:
        """A transaction is on the chain, perhaps not ours: if it was reverted before, it counts again."""
        if (entry := self._gone.pop(tx, None)) is not None:
            self._enter(tx, entry)

    def earnings(self) -> Earnings:
        """The sums now."""
        total = EarningsEntry(
            *(entered - reverted for entered, reverted in zip(self._entered, self._reverted, strict=True))
        )
        return Earnings(rejected=dict(self._rejected), **total._asdict())

    def turnover(self) -> Turnover:
        """Everything that was entered, and what of it was reverted."""
        return Turnover(self._matches, self._entered, self._reverted)

    def _enter(self, tx: str, entry: EarningsEntry) -> None:
        self.reverted(tx)
        self._gone.pop(tx, None)
        self._entered = _sum(self._entered, entry)
        _keep(self._mined, tx, entry)


def _keep(entries: OrderedDict[str, EarningsEntry], tx: str, entry: EarningsEntry) -> None:
    entries[tx] = entry
    if len(entries) > REMEMBERED:
        entries.popitem(last=False)


def _sum(total: EarningsEntry, more: EarningsEntry) -> EarningsEntry:
    return EarningsEntry(*(one + other for one, other in zip(total, more, strict=True)))


def _decimal(amount: int, digits: int) -> str:
    """An amount of the smallest unit as a decimal number, exactly."""
    whole, part = divmod(amount, 10**digits)
    return f"{whole:,}.{part:0{digits}}".rstrip("0").rstrip(".")
