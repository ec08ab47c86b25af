"""`aira liability show`: one liability."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

import click

from mesh.cli.liability.words import facts_of, spoken, units_of
from mesh.cli.opening import for_reading, own_address, reading
from mesh.cli.printing import plural, print_facts, print_json, with_json
from mesh.running import run_to_end

if TYPE_CHECKING:
    from mesh.chain import Chain, RefundState
    from mesh.settings import Settings
    from schemas.records import Liability


@click.command("show")
@click.argument("address")
@with_json
@for_reading()
def command(settings: Settings, address: str, as_json: bool) -> None:
    """Show the liability at ADDRESS: who does what for whom, for how much, how it stands, and from when on the money
    can be had back."""
    run_to_end(lambda: _show(settings, address, as_json))


async def _show(settings: Settings, address: str, as_json: bool) -> None:
    own = await asyncio.to_thread(own_address, settings)
    async with reading(settings) as chain:
        await print_liability(chain, await chain.liabilities.get(address), own=own, as_json=as_json)


async def print_liability(chain: Chain, liability: Liability, *, own: str | None, as_json: bool) -> None:
    """Print all that there is to say of a liability."""
    refund = await refund_state(chain, liability)
    if as_json:
        print_json(facts_of(liability) | {"refundableFrom": None if refund is None else refund.refundable_from})
        return
    units = await units_of(chain, [liability])
    words = None if refund is None else refund_words(refund)
    print_facts(spoken(liability, units[liability.token], own=own, refundable=words))


async def refund_state(chain: Chain, liability: Liability) -> RefundState | None:
    """From when on an open liability's money can be had back; None for one that has ended, or where it never can."""
    from mesh.chain import NotOffered

    try:
        return None if liability.is_finalized else await chain.liabilities.refund_state(liability.address)
    except NotOffered:
        return None


def refund_words(refund: RefundState) -> str:
    """When the promisee can have the money back, in words."""
    if refund.is_refundable:
        return "possible now, by `aira liability cancel --refund`"
    blocks = refund.refundable_from - refund.block_number
    return f"possible from block {refund.refundable_from:,} on, in {plural(blocks, 'block')}"
