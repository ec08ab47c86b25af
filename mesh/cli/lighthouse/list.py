"""`aira lighthouse list`: all markets of the factory."""

from __future__ import annotations

from typing import TYPE_CHECKING

import click

from mesh.cli.amounts import XRT
from mesh.cli.lighthouse.words import facts_of
from mesh.cli.opening import for_reading, reading
from mesh.cli.printing import plural, print_json, print_table, say, visible, with_json
from mesh.running import run_to_end

if TYPE_CHECKING:
    from mesh.settings import Settings


@click.command("list")
@click.option(
    "--from-block", type=click.IntRange(min=0), default=0, show_default=True, help="only those made since this block"
)
@with_json
@for_reading()
def command(settings: Settings, from_block: int, as_json: bool) -> None:
    """List all lighthouses of the factory, in the order in which they were made."""
    run_to_end(lambda: _list(settings, from_block, as_json))


async def _list(settings: Settings, from_block: int, as_json: bool) -> None:
    async with reading(settings) as chain:
        found = [
            (made.name, await chain.lighthouses.get(made.lighthouse))
            for made in await chain.lighthouses.list(from_block=from_block)
        ]
    if as_json:
        print_json([facts_of(name, state) for name, state in found])
        return
    rows = [
        (
            visible(name),
            state.address,
            XRT.show(state.minimal_stake),
            plural(state.timeout_blocks, "block"),
            len(state.stakes),
            XRT.show(sum(state.stakes.values())),
        )
        for name, state in found
    ]
    if rows:
        head = ("NAME", "ADDRESS", "MINIMAL STAKE", "TIMEOUT", "PROVIDERS", "STAKED")
        print_table(head, rows, numbers=head[2:])
    else:
        say("no lighthouse was made here" + (f" since block {from_block:,}" if from_block else ""))
