"""`aira liability watch`: what becomes of one liability, or of all."""

from __future__ import annotations

import asyncio
import logging
from contextlib import aclosing
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any

import click

from mesh.cli.liability.show import print_liability
from mesh.cli.liability.words import OUTCOMES, facts_of, short, state_of, units_of
from mesh.cli.opening import for_reading, own_address, reading
from mesh.cli.printing import print_json, say, with_json
from mesh.outage_log import OutageLog
from mesh.running import run_to_end

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    from mesh.chain import BlockEvents, Chain
    from mesh.cli.amounts import Unit
    from mesh.errors import AiraError
    from mesh.settings import Settings
    from schemas.records import Liability

log = logging.getLogger(__name__)


@click.command("watch")
@click.argument("address", required=False)
@click.option("--from-block", type=click.IntRange(min=0), help="without ADDRESS: begin at this block [the next]")
@with_json
@for_reading("confirmations", "poll_interval")
def command(settings: Settings, address: str | None, from_block: int | None, as_json: bool) -> None:
    """Follow the liability at ADDRESS until it has ended, and show it then. A node that is lost is waited for.

    Without ADDRESS, tell of each liability that is made, and of each that ends, until Ctrl-C; with --json an object a
    line.
    """
    if address is None:
        run_to_end(lambda: _watch_all(settings, from_block, as_json))
    else:
        run_to_end(lambda: _watch(settings, address, as_json))


async def _watch(settings: Settings, address: str, as_json: bool) -> None:
    own = await asyncio.to_thread(own_address, settings)
    async with reading(settings) as chain:
        liability = await chain.liabilities.get(address)
        if not liability.is_finalized and not as_json:
            say(f"{liability.address} is {OUTCOMES['open']}; waiting for its end (Ctrl-C leaves it as it is)")
        await print_liability(chain, await chain.liabilities.watch(address), own=own, as_json=as_json)


async def _watch_all(settings: Settings, from_block: int | None, as_json: bool) -> None:
    own = await asyncio.to_thread(own_address, settings)
    async with reading(settings) as chain:
        cursor = await chain.block_number() + 1 if from_block is None else from_block
        if not as_json:
            click.echo(f"watching from block {cursor:,} on; Ctrl-C ends it", err=True)
        async for happening in _followed(chain, cursor):
            if as_json:
                print_json(happening.facts())
            else:
                say(happening.words(own=own))


@dataclass(frozen=True, kw_only=True)
class Happening:
    """A liability was made, or ended; `liability` is its record by now, `unit` that of its token."""

    event: str
    block_number: int
    tx: str
    liability: Liability
    unit: Unit

    def facts(self) -> dict[str, Any]:
        """It, for programs."""
        about = {"event": self.event, "blockNumber": self.block_number, "tx": self.tx}
        return about | {"liability": facts_of(self.liability)}

    def words(self, *, own: str | None) -> str:
        """It, for people."""
        promisor, promisee = (short(address, own=own) for address in (self.liability.promisor, self.liability.promisee))
        word = "made" if self.event == "made" else state_of(self.liability)
        cost = self.unit.show(self.liability.cost)
        return f"block {self.block_number:,}  {self.liability.address}  {word:<10}  {promisor} for {promisee}, {cost}"


@dataclass(frozen=True, kw_only=True)
class TakenBack:
    """The chain was reorganised: the making or the end of a liability did not happen after all."""

    what: str
    liability: str
    tx: str

    def facts(self) -> dict[str, Any]:
        """It, for programs."""
        return {"event": "taken-back", "what": self.what, "liability": self.liability, "tx": self.tx}

    def words(self, *, own: str | None) -> str:
        """It, for people."""
        return f"the chain was reorganised: {self.liability} was not {self.what} after all"


class _SaidOutages(OutageLog):
    """Says on standard error that the node is lost, once an outage."""

    def __init__(self) -> None:
        super().__init__(log, "chain")
        self._is_down = False

    def failed(self, error: AiraError, consequence: str) -> None:
        if not self._is_down:
            click.echo(f"aira: {error}; waiting for it", err=True)
        self._is_down = True

    def recovered(self, message: str) -> None:
        self._is_down = False


async def _followed(chain: Chain, cursor: int) -> AsyncIterator[Happening | TakenBack]:
    """What happens to liabilities from a block on; outages of the node are survived, and said once."""
    outages = _SaidOutages()
    async with aclosing(chain.follow(cursor, outages=outages)) as blocks:
        async for block in blocks:
            for happening in await chain.retrying(partial(_happenings, chain, block), outages=outages):
                yield happening


async def _happenings(chain: Chain, block: BlockEvents) -> list[Happening | TakenBack]:
    """What a block, or its going, means for liabilities, in order."""
    from mesh.chain import Finalized, NewLiability, NoContracts, Reorganisation

    words = {NewLiability: "made", Finalized: "ended"}
    found: list[Happening | TakenBack] = []
    for event in block.reverted_events if isinstance(block, Reorganisation) else ():
        if isinstance(event, NewLiability | Finalized):
            found.append(TakenBack(what=words[type(event)], liability=event.liability, tx=event.tx))
    for event in block.events:
        if not isinstance(event, NewLiability | Finalized):
            continue
        try:
            liability = await chain.liabilities.get(event.liability)
        except NoContracts:  # the chain was reorganised meanwhile, which is told next
            continue
        unit = (await units_of(chain, [liability]))[liability.token]
        number, word = block.block_number, words[type(event)]
        found.append(Happening(event=word, block_number=number, tx=event.tx, liability=liability, unit=unit))
    return found
