"""The accounts of an account: what each contract has earned and cost, and the sums per month and model.

A contract belongs to the time at which it ended, because then it pays; one that is open, to that of its creation. So
the statement of a past month never changes, except that contracts that were open have left it.
"""

from __future__ import annotations

import time
from calendar import monthrange
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Final

from mesh.errors import InputError
from schemas.address import ZERO_ADDRESS

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

    from mesh.chain import Chain, Dated, GasPaid
    from schemas import Liability

FOREVER: Final = 2**40
"""Unix time, later than that of any block."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Entry:
    """A contract in a statement. `time` (Unix) and `block` are those of its end, or of its creation if it is open.

    `earned` and `spent` are what the account received and paid for the job, in the smallest unit of the contract's
    token, also to the provider for a permit; `fee` is what it paid to the provider for its offer, or to the validator,
    in wn. `gas` is what the transactions of creation
    and end cost, in wei, and `own_gas` what the account itself paid of that. Both are None where the node does not say
    the price. `tx` is the transaction at `time`.
    """

    time: int
    block: int
    liability: Liability
    earned: int
    spent: int
    fee: int
    gas: int | None
    own_gas: int | None
    tx: str

    @property
    def token(self) -> str:
        """The token (address) that pays for the job."""
        return self.liability.token

    @property
    def model(self) -> str:
        """The model of the job (a CID)."""
        return self.liability.model

    @property
    def month(self) -> str:
        """The month in UTC: `2026-11`."""
        return time.strftime("%Y-%m", time.gmtime(self.time))


@dataclass(frozen=True, slots=True, kw_only=True)
class Sum:
    """What the contracts of one month, model and token come to, in the units of `Entry`; `paid` counts the paid ones.

    Unknown costs of gas count nothing.
    """

    month: str
    model: str
    token: str
    contracts: int
    paid: int
    earned: int
    spent: int
    fee: int
    gas: int
    own_gas: int


@dataclass(frozen=True, slots=True)
class Statement:
    """The contracts of an account in a period, by time: `await agent.statement("2026-11")`."""

    account: str
    entries: tuple[Entry, ...]

    @property
    def sums(self) -> tuple[Sum, ...]:
        """The sums per month, model and token, in this order."""
        groups: dict[tuple[str, str, str], list[Entry]] = {}
        for entry in self.entries:
            groups.setdefault((entry.month, entry.model, entry.token), []).append(entry)
        return tuple(_sum(*key, groups[key]) for key in sorted(groups))


def period(first: str, last: str) -> tuple[int, int]:
    """The Unix times from the begin of one day or month to the end of another (UTC), excluded; empty ones are open.

    Raises `InputError` for what is neither `2026-11-30` nor `2026-11`.
    """
    since, until = _day(first)[0] if first else 0, _day(last)[1] if last else FOREVER
    if until <= since:
        raise InputError(f"{last} is before {first}", hint="exchange the two dates", code="invalid-date")
    return since, until


async def read_statement(chain: Chain, account: str, *, since: int = 0, until: int = FOREVER) -> Statement:
    """The statement of an account (address) from one Unix time to another, excluded. Raises `NodeUnreachable`."""
    first = await chain.node.first_block_since(since) if since else 0
    found = [
        dated
        for dated in await chain.liabilities.history(from_block=first, party=account)
        if since <= (dated.ended or dated.created).time < until
    ]
    gas = await chain.liabilities.gas_of(step.tx for one in found for step in (one.created, one.ended) if step)
    entries = [_entry(dated, account, gas) for dated in found]
    return Statement(account, tuple(sorted(entries, key=lambda entry: (entry.time, entry.block))))


def _entry(dated: Dated, account: str, gas: Mapping[str, GasPaid]) -> Entry:
    from mesh.chain import Holding, permit_fee  # here, for importing an agent must not load the chain

    one, last = dated.liability, dated.ended or dated.created
    steps = {step.tx: gas[step.tx] for step in (dated.created, last)}.values()
    is_paid = one.state == "paid"
    # The provider's fee is due at the creation; the validator's comes back from a contract without a result.
    fee = one.lighthouse_fee if one.promisor == account else 0
    if one.promisee == account and one.validator != ZERO_ADDRESS and one.state in ("paid", "failed"):
        fee += one.validator_fee
    made = gas[dated.created.tx]
    # It is only charged if the contract was created with the permit.
    paid_for_permit = min(permit_fee(one), made.received.get(Holding(one.token, one.promisee), 0))
    return Entry(
        time=last.time,
        block=last.block_number,
        liability=one,
        earned=one.cost if is_paid and one.promisor == account else 0,
        spent=(one.cost if is_paid else 0) + paid_for_permit if one.promisee == account else 0,
        fee=fee,
        gas=_total(step.wei for step in steps),
        own_gas=_total(step.wei for step in steps if step.payer == account),
        tx=last.tx,
    )


def _total(amounts: Iterable[int | None]) -> int | None:
    known = list(amounts)
    return None if None in known else sum(one for one in known if one is not None)


def _sum(month: str, model: str, token: str, entries: Sequence[Entry]) -> Sum:
    return Sum(
        month=month,
        model=model,
        token=token,
        contracts=len(entries),
        paid=sum(entry.liability.state == "paid" for entry in entries),
        earned=sum(entry.earned for entry in entries),
        spent=sum(entry.spent for entry in entries),
        fee=sum(entry.fee for entry in entries),
        gas=sum(entry.gas or 0 for entry in entries),
        own_gas=sum(entry.own_gas or 0 for entry in entries),
    )


def _day(text: str) -> tuple[int, int]:
    """The Unix times at which a day or a month begins and ends."""
    for layout in ("%Y-%m-%d", "%Y-%m"):
        try:
            begin = datetime.strptime(text, layout).replace(tzinfo=UTC)
        except ValueError:
            continue
        days = 1 if layout == "%Y-%m-%d" else monthrange(begin.year, begin.month)[1]
        start = int(begin.timestamp())
        return start, start + days * 86_400
    raise InputError(
        f"{text[:40]!r} is not a date", hint="write a day, 2026-11-30, or a month, 2026-11", code="invalid-date"
    )
