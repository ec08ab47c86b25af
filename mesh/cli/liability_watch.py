"""`aira liability watch`: follows one liability until it ends, or all of them."""

from __future__ import annotations

import asyncio
import logging
from contextlib import aclosing
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any

import click

from mesh.background import Background
from mesh.cli.chain_client import open_chain, own_address, units_of
from mesh.cli.liability import liability_json, print_liability, state_of
from mesh.cli.options import ADDRESS, with_chain_settings, with_json
from mesh.cli.output import print_json, print_line, short_address
from mesh.cli.verdicts import print_verdicts
from mesh.outage_log import OutageLog
from mesh.settings import NetworkSettings, options_of

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    from mesh.amounts import Unit
    from mesh.chain import BlockEvents, Chain
    from mesh.errors import AiraError
    from mesh.settings import Settings
    from schemas.records import Liability


HEAD = ("LIABILITY", "STATE", "COST", "PROMISEE", "PROMISOR")


log = logging.getLogger(__name__)


@click.command("watch")
@click.argument("address", required=False, type=ADDRESS)
@click.option(
    "--from-block", type=click.IntRange(min=0), help="without ADDRESS: the first block to read [the next one]"
)
@with_json
@with_chain_settings(*options_of(NetworkSettings), "lighthouse_contract", "confirmations", "poll_interval")
async def watch(settings: Settings, address: str | None, from_block: int | None, as_json: bool) -> None:
    """Wait until the liability at ADDRESS has ended, then show it. If the node is unreachable, wait for it. If it names
    a validator, print how its jurors judge when they do.

    Without ADDRESS, print each liability when it is created and when it ends, until Ctrl-C; with --json one object per
    line.
    """
    if address is None:
        await _watch_all(settings, from_block, as_json)
        return
    own = await asyncio.to_thread(own_address, settings)
    async with open_chain(settings) as chain:
        liability = await chain.liabilities.get(address)
        async with Background() as tasks:
            if not liability.is_finalized and not as_json:
                print_line(f"{liability.address} is open; waiting until it ends (Ctrl-C stops waiting)")
                tasks.start(print_verdicts(settings, chain, liability), "verdicts")
            ended = await chain.liabilities.watch(address)
        await print_liability(chain, ended, settings, own=own, as_json=as_json)


async def _watch_all(settings: Settings, from_block: int | None, as_json: bool) -> None:
    own = await asyncio.to_thread(own_address, settings)
    async with open_chain(settings) as chain:
        cursor = await chain.block_number() + 1 if from_block is None else from_block
        if not as_json:
            click.echo(f"watching from block {cursor:,}; Ctrl-C stops it", err=True)
        async for event in _follow(chain, cursor):
            if as_json:
                print_json(event.json())
            else:
                print_line(event.line(own=own))


@dataclass(frozen=True, kw_only=True)
class LiabilityEvent:
    """A liability was created or has ended. `liability` is its current record, `unit` the unit of its token."""

    event: str
    block_number: int
    tx: str
    liability: Liability
    unit: Unit

    def json(self) -> dict[str, Any]:
        """The event for JSON."""
        about = {"event": self.event, "blockNumber": self.block_number, "tx": self.tx}
        return about | {"liability": liability_json(self.liability)}

    def line(self, *, own: str | None) -> str:
        """The event in a line for people."""
        promisor, promisee = (
            short_address(address, own=own) for address in (self.liability.promisor, self.liability.promisee)
        )
        word = "created" if self.event == "made" else state_of(self.liability)
        cost = self.unit.show(self.liability.cost)
        return f"block {self.block_number:,}  {self.liability.address}  {word:<10}  {promisor} for {promisee}, {cost}"


@dataclass(frozen=True, kw_only=True)
class EventReverted:
    """A reorganisation reverted the creation or the end of a liability."""

    what: str
    liability: str
    tx: str

    def json(self) -> dict[str, Any]:
        """The event for JSON."""
        return {"event": "taken-back", "what": self.what, "liability": self.liability, "tx": self.tx}

    def line(self, *, own: str | None) -> str:
        """The event in a line for people."""
        what = "creation" if self.what == "made" else "end"
        return f"a reorganisation reverted the {what} of {self.liability}"


class _PrintedOutages(OutageLog):
    """Prints to stderr that the node is unreachable, once per outage."""

    def __init__(self) -> None:
        super().__init__(log, "chain")
        self._has_failed = False

    def failed(self, error: AiraError, consequence: str) -> None:
        """Print `error`, unless the outage is already known."""
        if not self._has_failed:
            click.echo(f"aira: {error}; waiting for it", err=True)
        self._has_failed = True

    def recovered(self, message: str) -> None:
        """The next failure is another outage."""
        self._has_failed = False


async def _follow(chain: Chain, cursor: int) -> AsyncIterator[LiabilityEvent | EventReverted]:
    """Events of liabilities from a block on. Waits while the node is unreachable, and prints that once."""
    outages = _PrintedOutages()
    async with aclosing(chain.follow(cursor, outages=outages)) as blocks:
        async for block in blocks:
            for event in await chain.retrying(partial(_liability_events, chain, block), outages=outages):
                yield event


async def _liability_events(chain: Chain, block: BlockEvents) -> list[LiabilityEvent | EventReverted]:
    """The events of liabilities in a block or a reorganisation, in order."""
    from mesh.chain import Finalized, NewLiability, NoContracts, Reorganisation

    words = {NewLiability: "made", Finalized: "ended"}
    found: list[LiabilityEvent | EventReverted] = []
    for event in block.reverted_events if isinstance(block, Reorganisation) else ():
        if isinstance(event, NewLiability | Finalized):
            found.append(EventReverted(what=words[type(event)], liability=event.liability, tx=event.tx))
    for event in block.events:
        if not isinstance(event, NewLiability | Finalized):
            continue
        try:
            liability = await chain.liabilities.get(event.liability)
        except NoContracts:  # reverted meanwhile: the reorganisation comes next
            continue
        unit = (await units_of(chain, [liability]))[liability.token]
        number, word = block.block_number, words[type(event)]
        found.append(LiabilityEvent(event=word, block_number=number, tx=event.tx, liability=liability, unit=unit))
    return found
