"""What a provider earns and spends, and which contracts it creates.

It creates those that cover its gas, its customers', and a number of free ones a day. Creating and finalizing a contract
costs the provider gas, and on OP-type rollups a fee for the data, which counts as the gas that it would buy. Three
things cover it: the fee of the offer, the fee for the demand's permit, and what the factory mints when work was paid
for. They count at the factory's rate, by default 1 wn for a unit of gas, and a fee for a permit only in XRT: what it is
worth in another token is not known. Anybody can sign any number of orders without them, with keys made for it.
"""

from __future__ import annotations

import logging
import operator
from collections import Counter
from typing import TYPE_CHECKING, Final, NamedTuple

import msgspec

from mesh.amounts import ETH, XRT
from mesh.base.clock import SYSTEM_CLOCK
from mesh.base.flood import BoundedDict
from mesh.base.log_context import liability_context, log_event
from schemas import ZERO_ADDRESS

if TYPE_CHECKING:
    from collections.abc import Collection

    from mesh.base.clock import Clock
    from mesh.chain import Created, Reverted, Settled
    from mesh.market.book import Match
    from mesh.market.store import MarketStore
    from schemas import Demand, Liability
    from schemas.rpc import PermitFeeRequest


log = logging.getLogger(__name__)

REASONS: Final = 64
"""Rejection reasons that are counted apart; further ones, which a stranger's contract may invent, count as `OTHER`."""
OTHER: Final = "Other"
REMEMBERED: Final = 4096
"""Transactions whose entries can still be reverted, or come back; a reorganisation replaces only the last blocks."""


class Earnings(msgspec.Struct, frozen=True, kw_only=True):
    """What a provider did so far, without what reorganisations reverted.

    Contracts created and finalized; messages rejected, by reason; gas used, and wei spent on it, including failed
    transactions; fees earned in XRT, and XRT minted for the gas (both wn).
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
            f"earned {XRT.show(self.fees + self.minted)} ({XRT.number(self.fees)} in fees, "
            f"{XRT.number(self.minted)} minted for gas), spent {ETH.show(self.spent)} on {self.gas_used:,} gas"
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
        self._mined: BoundedDict[str, EarningsEntry] = BoundedDict(REMEMBERED)
        self._gone: BoundedDict[str, EarningsEntry] = BoundedDict(REMEMBERED)

    def created(self, created: Created, *, fee: int) -> None:
        """A contract was created, for which its parties paid `fee` (wn)."""
        entry = EarningsEntry(created=1, gas_used=created.gas_used, spent=created.wei, fees=fee)
        self._enter(created.tx, entry)

    def finalized(self, settled: Settled) -> None:
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
            self._gone[tx] = entry

    def mined(self, tx: str) -> None:
        """A transaction is on the chain, perhaps not ours: if it was reverted before, it counts again."""
        if (entry := self._gone.pop(tx, None)) is not None:
            self._enter(tx, entry)

    def earnings(self) -> Earnings:
        """The sums now."""
        total = EarningsEntry(*map(operator.sub, self._entered, self._reverted))
        return Earnings(rejected=dict(self._rejected), **total._asdict())

    def turnover(self) -> Turnover:
        """Everything that was entered, and what of it was reverted."""
        return Turnover(self._matches, self._entered, self._reverted)

    def _enter(self, tx: str, entry: EarningsEntry) -> None:
        self.reverted(tx)
        self._gone.pop(tx, None)
        self._entered = _sum(self._entered, entry)
        self._mined[tx] = entry


def _sum(total: EarningsEntry, more: EarningsEntry) -> EarningsEntry:
    return EarningsEntry(*map(operator.add, total, more))


class LiabilityGas(NamedTuple):
    """Gas of creation and finalization, as in contracts/src/Emission.sol."""

    third: int = 268_000
    """Of a liability of generation 3, and …"""
    fifth: int = 224_000
    """… of one of generation 5, plus …"""
    cost: int = 51_000
    """… this if the demand has a cost, and …"""
    fee: int = 19_500
    """… this if the offer has a fee, and …"""
    permit_fee: int = 16_300
    """… this if the demand has a fee for its permit."""


GAS: Final = LiabilityGas()
DATA_MARGIN: Final = 2
"""How many times the fee for data may grow until the contract is created for which a fee for its permit is wanted."""


class FreeLimits(NamedTuple):
    """How many contracts that don't cover their gas are created."""

    a_day: int = 100
    """A day, by default."""
    parts: int = 4
    """One of so many parts of a day's can be used at once, so that they last for the day."""
    saved: int = 16
    """Those that a customer can have saved up, one for each contract that has covered its gas."""
    customers: int = 4096
    """Customers of whom that is remembered."""


FREE_LIMITS: Final = FreeLimits()


class FreeContracts:
    """What the provider `account` creates of the contracts that don't cover its gas, in a market that pays in `xrt`.

    It creates those of `customers` (addresses), one for each earlier contract of the same maker that brought what it
    cost, and `a_day` others. How many of these are left is kept in `store`. With `always_minted` the factory mints for
    every contract, as the originals do.
    """

    def __init__(
        self,
        account: str,
        xrt: str,
        *,
        a_day: int = FREE_LIMITS.a_day,
        customers: Collection[str] = (),
        always_minted: bool = False,
        emission: int = 100,
        store: MarketStore,
        clock: Clock = SYSTEM_CLOCK,
    ) -> None:
        self._account = account
        self._xrt = xrt
        self._emission = emission
        self.a_day = a_day
        self._customers = frozenset(customers)
        self._always_minted = always_minted
        self._store = store
        self._clock = clock
        self._credit: BoundedDict[str, int] = BoundedDict(FREE_LIMITS.customers)
        self._most = max(a_day / FREE_LIMITS.parts, 1.0) if a_day else 0.0
        left, at = store.free_contracts() or (self._most, clock.time())
        self._left, self._at = min(left, self._most), min(at, clock.time())
        self.created = 0
        """How many it has created since it started."""

    def left(self) -> int:
        """How many may be created now for strangers."""
        return int(self._refilled(self._clock.time()))

    def lacking(self, match: Match, *, data_gas: int = 0, permit_fee: int = 0) -> int:
        """The wn that a contract lacks to cover the provider's gas; 0 if it covers it.

        `data_gas` is what its data costs besides, as gas; nothing is minted for that. `permit_fee` is what the
        demand pays for its permit, in its token; it counts if that is XRT.
        """
        demand, fee = match.demand.message, match.offer.message.lighthouse_fee
        are_strangers = len({match.demand.signer, match.offer.signer, self._account}) == 3
        not_minted = self._not_minted(demand, fee=fee, are_strangers=are_strangers)
        if permit_fee:
            data_gas += GAS.permit_fee
            fee += permit_fee if demand.token == self._xrt else 0
        return max(not_minted + self._worth(data_gas) - fee, 0)

    def permit_fee(self, wanted: PermitFeeRequest, *, data_gas: int = 0) -> int:
        """The fee for its permit with which a demand's contract is created now; `data_gas` as for `lacking`.

        0 if it is created without, and in a token that does not count.
        """
        not_minted = self._not_minted(wanted, are_strangers=wanted.maker != self._account)
        has_free = wanted.maker in self._customers or self._credit.get(wanted.maker, 0) or self.left()
        if has_free or wanted.token != self._xrt or not not_minted + self._worth(data_gas):
            return 0
        return not_minted + self._worth(DATA_MARGIN * data_gas + GAS.permit_fee)

    def why(self, match: Match, *, data_gas: int = 0) -> str:
        """Why a contract that does not cover the gas is not created, for the makers of its orders."""
        demand, fee = match.demand.message, match.offer.message.lighthouse_fee
        enough = f"a cost of {XRT.show(self._worth(_gas(demand.generation, 1, fee)))} does"
        if demand.token != self._xrt or data_gas:
            gas = _gas(demand.generation, demand.cost, 1) + data_gas
            enough = f"a fee of {XRT.show(self._worth(gas))} in the offer does"
        if demand.token == self._xrt and demand.validator == ZERO_ADDRESS and not self._always_minted:
            for_permit = self.lacking(match, data_gas=DATA_MARGIN * data_gas + GAS.permit_fee)
            enough += f", or a permit fee of {XRT.show(for_permit)} (--permit-fee)"
        return f"its contract would not cover the provider's gas, and there is no free one left now: {enough}, or wait"

    async def take(self, match: Match) -> bool:
        """Whether to create a contract that does not cover its gas; what it uses up is on disk when this returns."""
        maker = match.demand.signer
        if maker not in self._customers:
            if credit := self._credit.get(maker, 0):
                self._credit[maker] = credit - 1
            else:
                now = self._clock.time()
                left = self._refilled(now)
                if left < 1.0:
                    return False
                self._left, self._at = left - 1.0, now
                await self._store.keep_free_contracts(self._left, self._at)
        self.created += 1
        return True

    def earned(self, liability: Liability, minted: int) -> None:
        """A contract was finalized, for which the factory minted so much wn: its maker may have a free one for it."""
        maker = liability.promisee
        if minted + liability.lighthouse_fee >= self._worth(GAS.fifth):
            self._credit[maker] = min(self._credit.get(maker, 0) + 1, FREE_LIMITS.saved)

    def _not_minted(self, order: Demand | PermitFeeRequest, *, fee: int = 0, are_strangers: bool) -> int:
        """What nothing is minted for of a contract's gas, in wn; with a `fee` in its offer."""
        worth = self._worth(_gas(order.generation, order.cost, fee))
        is_minted = order.token == self._xrt and are_strangers
        return worth - (worth if self._always_minted else min(order.cost, worth) if is_minted else 0)

    def _worth(self, gas: int) -> int:
        return gas * self._emission // 100

    def _refilled(self, now: float) -> float:
        return min(self._left + max(now - self._at, 0.0) * self.a_day / 86_400, self._most)


def _gas(generation: int, cost: int, fee: int) -> int:
    return (GAS.third if generation == 3 else GAS.fifth) + (GAS.cost if cost else 0) + (GAS.fee if fee else 0)
