"""`aira liability list`: the liabilities of an account, or all."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Any

import click

from mesh.cli.liability.words import facts_of, short, state_of, units_of
from mesh.cli.opening import for_reading, own_address, reading
from mesh.cli.printing import print_json, print_table, say, with_json
from mesh.cli.tokens import account_of
from mesh.running import run_to_end

if TYPE_CHECKING:
    from collections.abc import Sequence

    from mesh.chain import Chain
    from mesh.settings import Settings
    from schemas.records import Liability

HEAD = ("LIABILITY", "STATE", "COST", "PROMISEE", "PROMISOR")


@click.command("list")
@click.option("--account", help="address or ENS name of a promisee or promisor [the settings' account]")
@click.option("--all", "everybody", is_flag=True, help="those of everybody")
@click.option(
    "--state",
    type=click.Choice(["any", "open", "finalized"]),
    default="any",
    show_default=True,
    help="only those that are open, or that have ended",
)
@click.option(
    "--from-block", type=click.IntRange(min=0), default=0, show_default=True, help="only those made since this block"
)
@with_json
@for_reading()
def command(settings: Settings, **what: Any) -> None:
    """List the liabilities of an account, first those that it pays for, then those that it works for; or all.

    Each kind is in the order in which they were made. Without an account in the settings, all are listed. A long chain
    takes its time to be read: --from-block shortens that.
    """
    run_to_end(lambda: _list(settings, **what))


async def _list(
    settings: Settings, *, account: str | None, everybody: bool, state: str, from_block: int, as_json: bool
) -> None:
    own = await asyncio.to_thread(own_address, settings)
    async with reading(settings) as chain:
        whose = None if everybody or (account is None and own is None) else await account_of(chain, settings, account)
        found = await _found(chain, whose, from_block)
        if state != "any":
            found = [liability for liability in found if liability.is_finalized == (state == "finalized")]
        if as_json:
            print_json([facts_of(liability) for liability in found])
            return
        units = await units_of(chain, found)
    if not found:
        say(f"no {'' if state == 'any' else state + ' '}liabilities" + (f" of {whose}" if whose else ""))
        return
    rows = [
        (
            liability.address,
            state_of(liability),
            units[liability.token].show(liability.cost),
            short(liability.promisee, own=own),
            short(liability.promisor, own=own),
        )
        for liability in found
    ]
    print_table(HEAD, rows, numbers=("COST",))


async def _found(chain: Chain, whose: str | None, from_block: int) -> Sequence[Liability]:
    """All liabilities, or those of an account in either part; one with itself once."""
    if whose is None:
        return await chain.liabilities.list(from_block=from_block)
    paid = await chain.liabilities.list(from_block=from_block, promisee=whose)
    worked = await chain.liabilities.list(from_block=from_block, promisor=whose)
    return list({liability.address: liability for liability in (*paid, *worked)}.values())
