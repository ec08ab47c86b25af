"""`aira statement`: what an account has earned and spent."""

from __future__ import annotations

import csv
import io
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any, Final, TypeAlias, TypeVar

import click

from mesh.agent.statement import Entry, Sum, period, read_statement
from mesh.amounts import ETH, XRT
from mesh.cli.chain_client import account_of, open_chain
from mesh.cli.options import ADDRESS, with_chain_settings, with_json
from mesh.cli.output import format_time, iso_time, print_json, print_line, print_table, printable, short_address

if TYPE_CHECKING:
    from collections.abc import Sequence

    from mesh.agent.statement import Statement
    from mesh.amounts import Unit
    from mesh.settings import Settings

    Units: TypeAlias = Mapping[str, Unit]

T = TypeVar("T", bound=Entry | Sum)


FORMULA: Final = tuple("=+-@\uff1d\uff0b\uff0d\uff20")
"""How cells begin that a spreadsheet calculates, also in full width. A token's symbol is a stranger's word."""


@click.command()
@click.option("--from", "first", default="", metavar="DATE", help="first day, 2026-11-30, or month, 2026-11 [any]")
@click.option("--to", "last", default="", metavar="DATE", help="last day or month, included [today]")
@click.option("--account", type=ADDRESS, help="address or ENS name of the account [the settings' account]")
@click.option("--sums", "only_sums", is_flag=True, help="print the sums only, without the contracts")
@click.option("--csv", "as_csv", is_flag=True, help="print CSV only to stdout, for a spreadsheet")
@with_json
@with_chain_settings()
async def statement(
    settings: Settings, *, first: str, last: str, account: str | None, only_sums: bool, as_csv: bool, as_json: bool
) -> None:
    """Show what the account has earned and spent: a row for each contract, and the sums per month and model.

    Times are UTC. A contract is in the month in which it ended; an open one in that of its creation. EARNED and SPENT
    are the costs of paid jobs, and SPENT also what the provider got for a permit; FEE is what the account paid to the
    provider for an offer, or to the validator, in XRT; GAS is what the transactions of the contract cost, of which OWN
    GAS was paid by the account, in the chain's coin.

    --csv has exact decimals without separators, also the parties, blocks, transactions and recordings.
    """
    if as_csv and as_json:
        raise click.UsageError("--csv and --json can't be used together")
    since, until = period(first, last)
    async with open_chain(settings) as chain:
        whose = await account_of(chain, settings, account)
        found = await read_statement(chain, whose, since=since, until=until)
        units = await chain.tokens.units(one.token for one in found.entries)
    if as_json:
        print_json(statement_json(found, units))
    elif as_csv and only_sums:
        print_line(csv_of(SUM_COLUMNS, found.sums, units).rstrip("\n"))
    elif as_csv:
        print_line(csv_of(ENTRY_COLUMNS, found.entries, units).rstrip("\n"))
    elif not found.entries:
        print_line(f"no contracts of {whose} in this period")
    else:
        if not only_sums:
            _print_entries(found, units)
            print_line()
        _print_sums(found, units)


AMOUNTS: Final = ("EARNED", "SPENT", "FEE", "GAS", "OWN GAS")


def _amounts(one: Entry | Sum, unit: Unit) -> tuple[str, ...]:
    """The amounts for people, in the order of `AMOUNTS`."""
    return unit.show(one.earned), unit.show(one.spent), XRT.show(one.fee), _eth(one.gas), _eth(one.own_gas)


def _print_entries(found: Statement, units: Units) -> None:
    rows = []
    for entry in found.entries:
        one = entry.liability
        other = one.promisor if one.promisee == found.account else one.promisee
        amounts = _amounts(entry, units[entry.token])
        rows.append((format_time(entry.time), one.address, one.state, *amounts, short_address(other)))
    heads = ("TIME", "LIABILITY", "STATE", *AMOUNTS, "WITH")
    print_table(heads, rows, numbers=AMOUNTS)


def _print_sums(found: Statement, units: Units) -> None:
    rows = []
    for one in found.sums:
        amounts = _amounts(one, units[one.token])
        rows.append((one.month, one.model, f"{one.contracts:,}", f"{one.paid:,}", *amounts))
    counts = ("CONTRACTS", "PAID")
    print_table(("MONTH", "MODEL", *counts, *AMOUNTS), rows, numbers=(*counts, *AMOUNTS))


def _eth(wei: int | None) -> str:
    return "unknown" if wei is None else ETH.show(wei)


Column: TypeAlias = Callable[[T, "Unit"], str]
"""Writes one cell of a row, whose token has this unit."""

AMOUNT_COLUMNS: Final[Mapping[str, Column[Entry | Sum]]] = {
    "earned": lambda one, unit: unit.decimal(one.earned),
    "spent": lambda one, unit: unit.decimal(one.spent),
    "fee (XRT)": lambda one, _: XRT.decimal(one.fee),
    "gas (ETH)": lambda one, _: "" if one.gas is None else ETH.decimal(one.gas),
    "own gas (ETH)": lambda one, _: "" if one.own_gas is None else ETH.decimal(one.own_gas),
}
ENTRY_COLUMNS: Final[Mapping[str, Column[Entry]]] = {
    "time": lambda one, _: format_time(one.time),
    "month": lambda one, _: one.month,
    "block": lambda one, _: str(one.block),
    "liability": lambda one, _: one.liability.address,
    "state": lambda one, _: one.liability.state,
    "promisee": lambda one, _: one.liability.promisee,
    "promisor": lambda one, _: one.liability.promisor,
    "model": lambda one, _: one.model,
    "token": lambda one, _: one.token,
    "symbol": lambda _, unit: unit.symbol,
    "cost": lambda one, unit: unit.decimal(one.liability.cost),
    **AMOUNT_COLUMNS,
    "transaction": lambda one, _: one.tx,
    "recording": lambda one, _: one.liability.result,
}
SUM_COLUMNS: Final[Mapping[str, Column[Sum]]] = {
    "month": lambda one, _: one.month,
    "model": lambda one, _: one.model,
    "token": lambda one, _: one.token,
    "symbol": lambda _, unit: unit.symbol,
    "contracts": lambda one, _: str(one.contracts),
    "paid": lambda one, _: str(one.paid),
    **AMOUNT_COLUMNS,
}


def csv_of(columns: Mapping[str, Column[T]], rows: Sequence[T], units: Units) -> str:
    """Rows below their heads (RFC 4180), for a spreadsheet: nothing in them is a formula.

    `columns` are `ENTRY_COLUMNS` or `SUM_COLUMNS`, and `units` has that of each token.
    """
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(columns)
    writer.writerows([_cell(column(one, units[one.token])) for column in columns.values()] for one in rows)
    return text.getvalue()


def _cell(value: str) -> str:
    text = printable(value)
    return f"'{text}" if text.lstrip().startswith(FORMULA) else text


def statement_json(found: Statement, units: Units) -> dict[str, Any]:
    """The statement for JSON, with the `units` of its tokens.

    Amounts are text, in the smallest unit of their token, in wn or in wei.
    """
    contracts = []
    for entry in found.entries:
        one = entry.liability
        facts = {"time": iso_time(entry.time), "month": entry.month, "block": entry.block, "liability": one.address}
        facts |= {"state": one.state, "promisee": one.promisee, "promisor": one.promisor, "model": one.model}
        facts |= _token_json(one.token, units) | {"cost": str(one.cost)} | _amounts_json(entry)
        contracts.append(facts | {"tx": entry.tx, "result": one.result})
    sums = [
        {"month": one.month, "model": one.model, **_token_json(one.token, units)}
        | {"contracts": one.contracts, "paid": one.paid}
        | _amounts_json(one)
        for one in found.sums
    ]
    return {"account": found.account, "contracts": contracts, "sums": sums}


def _token_json(token: str, units: Units) -> dict[str, Any]:
    return {"token": token, "symbol": units[token].symbol, "decimals": units[token].decimals}


def _amounts_json(one: Entry | Sum) -> dict[str, str | None]:
    amounts = {"earned": one.earned, "spent": one.spent, "fee": one.fee, "gas": one.gas, "ownGas": one.own_gas}
    return {name: None if amount is None else str(amount) for name, amount in amounts.items()}
