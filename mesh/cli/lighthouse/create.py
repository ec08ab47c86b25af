"""`aira lighthouse create`: a new market."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import click

from mesh.cli.amounts import XRT
from mesh.cli.lighthouse.checks import check_lighthouse
from mesh.cli.lighthouse.rules import with_rules
from mesh.cli.opening import for_signing, patience, signing
from mesh.cli.printing import plural, print_facts, print_json, with_json
from mesh.errors import ChainError
from mesh.running import run_to_end

if TYPE_CHECKING:
    from mesh.chain import Chain
    from mesh.settings import Settings


@click.command("create")
@click.argument("name")
@with_rules
@with_json
@for_signing()
def command(settings: Settings, **plan: Any) -> None:
    """Make a lighthouse called NAME: 1 to 32 letters a to z, digits and -. Whoever stakes there is its provider."""
    run_to_end(lambda: _create(settings, **plan))


async def _create(settings: Settings, *, name: str, minimal_stake: str, timeout_blocks: int, as_json: bool) -> None:
    stake = XRT.parse(minimal_stake)
    check_lighthouse(name, minimal_stake=stake)
    async with signing(settings) as chain:
        full_name = f"{name}.lighthouse.{chain.generation}.robonomics.eth"
        await _check_free(chain, full_name)
        with patience():
            made = await chain.lighthouses.create(minimal_stake=stake, timeout_blocks=timeout_blocks, name=name)
    if as_json:
        facts = {"lighthouse": made.lighthouse, "name": full_name, "minimalStake": str(stake)}
        print_json(facts | {"timeoutBlocks": timeout_blocks, "tx": made.tx})
        return
    print_facts(
        {
            "lighthouse": made.lighthouse,
            "name": full_name,
            "minimal stake": XRT.show(stake),
            "timeout": plural(timeout_blocks, "block"),
            "transaction": made.tx,
        }
    )


async def _check_free(chain: Chain, name: str) -> None:
    from mesh.chain import UnknownName

    try:
        taken = await chain.names.address(name)
    except UnknownName:
        return
    raise ChainError(f"the name {name} is taken, by {taken}", hint="choose another name")
