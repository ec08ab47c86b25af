"""`aira peers`: who is on a lighthouse's channel."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import click

from mesh.cli.options import with_settings
from mesh.cli.printing import plural, print_json, print_table, say, visible, with_json
from mesh.running import run_to_end
from mesh.settings import NetworkSettings, options_of

if TYPE_CHECKING:
    from mesh.settings import Settings
    from mesh.watching import Peer
    from schemas.status import BridgeStatus


@click.command("peers")
@with_json
@with_settings(*options_of(NetworkSettings), "lighthouse_contract")
def command(settings: Settings, as_json: bool) -> None:
    """Show who is on the lighthouse's channel, by role and address, and how many nodes listen on the IPFS side.

    Who only watches does not show itself. `aira status` asks each of them how it is.
    """
    run_to_end(lambda: _peers(settings, as_json=as_json))


async def _peers(settings: Settings, *, as_json: bool) -> None:
    from mesh.agent.components import watching
    from mesh.watching import present, statuses
    from schemas.status import BridgeStatus

    async with watching(settings) as (network, channel):
        peers = await present(channel)
        bridges = [peer for peer in peers if peer.role == "bridge"]
        told = await statuses(network.session, channel, bridges)
    states = {peer: how for peer, how in told.items() if isinstance(how, BridgeStatus)}
    if as_json:
        print_json(_facts(channel.lighthouse, peers, states))
        return
    if peers:
        print_table(("role", "address"), [(peer.role, peer.address) for peer in peers])
    say(f"{len(peers) or 'nobody'} on {channel.lighthouse}; on the IPFS side {_ipfs_side(bridges, states)}")


def _facts(lighthouse: str, peers: list[Peer], states: dict[Peer, BridgeStatus]) -> dict[str, Any]:
    best = _best(states)
    return {
        "lighthouse": lighthouse,
        "peers": [{"role": peer.role, "address": peer.address} for peer in peers],
        "ipfsPeers": None if best is None else list(best.ipfs_peers),
    }


def _ipfs_side(bridges: list[Peer], states: dict[Peer, BridgeStatus]) -> str:
    """How many nodes of the legacy network are on the channel, as a bridge says."""
    best = _best(states)
    if best is None:
        return "nobody knows: no bridge answers" if bridges else "nobody knows: there is no bridge"
    nodes = plural(len(best.ipfs_peers), "node")
    return nodes if best.state in ("connected", "alone") else f"{nodes}; the bridge says: {visible(best.state)}"


def _best(states: dict[Peer, BridgeStatus]) -> BridgeStatus | None:
    """The bridge to believe: the one that carries, or the one that sees most nodes."""
    return max(states.values(), key=lambda how: (how.carries, len(how.ipfs_peers)), default=None)
