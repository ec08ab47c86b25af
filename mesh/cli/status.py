"""`aira status`: how agents, providers and bridges are."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

import click

from mesh.cli.options import with_settings
from mesh.cli.printing import print_facts, print_json, print_table, say, with_json
from mesh.errors import RemoteError
from mesh.running import run_to_end
from mesh.settings import NetworkSettings, options_of
from schemas import parse_address

if TYPE_CHECKING:
    from mesh.settings import Settings
    from mesh.watching import How


@click.command("status")
@click.argument("address", required=False)
@click.option(
    "--timeout", type=click.FloatRange(min=0, min_open=True), default=3.0, show_default=True, help="seconds to wait"
)
@with_json
@with_settings(*options_of(NetworkSettings), "lighthouse_contract")
def command(settings: Settings, address: str | None, timeout: float, as_json: bool) -> None:
    """Show how whoever has ADDRESS is: an agent, a provider, a bridge. Whether its parts are alive, how far it has
    read the chain, its jobs or its market.

    Without ADDRESS, everybody who is on the lighthouse's channel, a line each; with --json an object for all.
    """
    if address is None:
        run_to_end(lambda: _everybody(settings, timeout=timeout, as_json=as_json))
    else:
        run_to_end(lambda: _one(settings, address, timeout=timeout, as_json=as_json))


async def _one(settings: Settings, named: str, *, timeout: float, as_json: bool) -> None:
    from mesh.agent.components import watching
    from mesh.cli.conditions import spoken
    from mesh.watching import status_of

    address = parse_address(named)
    async with watching(settings) as (network, channel):
        told = await status_of(network.session, address, channel.lighthouse, timeout=timeout)
    if not told:
        raise RemoteError(
            f"nobody answers at {address}",
            hint="is it running, and on the same router? `aira peers` shows who is; a bridge needs its --lighthouse",
        )
    if as_json:
        print_json([_facts(how) for how in told])
        return
    for place, how in enumerate(told):
        if place:
            say()
        print_facts(spoken(how))


async def _everybody(settings: Settings, *, timeout: float, as_json: bool) -> None:
    from mesh.agent.components import watching
    from mesh.cli.conditions import in_short
    from mesh.watching import present, statuses

    async with watching(settings) as (network, channel):
        peers = await present(channel)
        told = await statuses(network.session, channel, peers, timeout=timeout)
    if as_json:
        people = [{"role": peer.role, "address": peer.address, "status": _facts(told[peer])} for peer in peers]
        print_json({"lighthouse": channel.lighthouse, "peers": people})
    elif peers:
        rows = [(peer.role, peer.address, in_short(told[peer])) for peer in peers]
        print_table(("role", "address", "how it is"), rows)
    else:
        say(f"nobody on {channel.lighthouse}")


def _facts(how: How | None) -> dict[str, Any] | None:
    """What somebody says of itself, as it travels."""
    return None if how is None else json.loads(how.encode())
