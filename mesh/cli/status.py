"""`aira status` and `aira peers`: the peers on a lighthouse's channel, and their status."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

import click

from mesh.amounts import ETH, XRT
from mesh.base.flood import Drops
from mesh.cli.options import with_json, with_settings, with_timeout
from mesh.cli.output import (
    format_duration,
    format_size,
    plural,
    print_facts,
    print_json,
    print_line,
    print_table,
    printable,
)
from mesh.settings import NetworkSettings
from mesh.telemetry.metrics import is_healthy
from schemas import parse_address
from schemas.decoding import decode_json
from schemas.status import ALIVE, BridgeStatus, Status

if TYPE_CHECKING:
    from collections.abc import Mapping

    from mesh.settings import Settings
    from mesh.watching import RoleStatus
    from schemas.status import ContentMetrics, DirectionStatus, MarketStatus, StoreUse, ValidationStatus, Work


@click.command("status")
@click.argument("address", required=False)
@with_timeout()
@with_json
@with_settings(NetworkSettings, "lighthouse_contract")
async def status(settings: Settings, address: str | None, timeout: float, as_json: bool) -> None:
    """Show the status of the agent, provider, validator or bridge with ADDRESS: the health of its parts, the last block
    read, and its jobs, its market or its cases.

    Without ADDRESS, show one line for each peer on the lighthouse's channel; with --json one object for all.
    """
    from mesh.network import no_answer
    from mesh.role.composition import watching
    from mesh.watching import RobotDirectory, status_of

    if address is None:
        await _show_all(settings, timeout=timeout, as_json=as_json)
        return
    address = parse_address(address)
    async with watching(settings) as (network, channel):
        profile = await RobotDirectory(network.session, channel).find(address)
        found = await status_of(network.session, address, channel.lighthouse, timeout=timeout)
    if not found:
        raise no_answer(address)
    if as_json:
        print_json([_status_json(status) for status in found])
        return
    for place, status in enumerate(found):
        if place:
            print_line()
        print_facts(({"name": profile.name} if profile is not None and profile.name else {}) | describe_status(status))


async def _show_all(settings: Settings, *, timeout: float, as_json: bool) -> None:
    from mesh.role.composition import watching
    from mesh.watching import BRIDGE, PROVIDER, RobotDirectory, present, statuses

    drops = Drops()
    async with watching(settings, drops=drops) as (network, channel):
        # Those first of whom there are few: a flood of agents that do not exist keeps the session busy for seconds.
        first = await present(channel, PROVIDER, BRIDGE)
        found = await statuses(network.session, channel, first, timeout=timeout)
        others = set(await present(channel)).difference(first)
        found |= await statuses(network.session, channel, sorted(others), timeout=timeout)
        robots = await RobotDirectory(network.session, channel).present(timeout=timeout)
    peers, names = sorted(found), {("agent", robot.address): robot.name for robot in robots if robot.name}
    if as_json:
        listed = [
            {"role": peer.role, "address": peer.address}
            | ({"name": names[peer]} if peer in names else {})
            | {"status": _status_json(found[peer])}
            for peer in peers
        ]
        print_json({"lighthouse": channel.lighthouse, "peers": listed, "unlisted": _unlisted(drops)})
        return
    if peers:
        rows = [(peer.role, peer.address, names.get(peer, ""), summarize_status(found[peer])) for peer in peers]
        head = ("role", "address", "name", "status")
        print_table(head, rows) if names else print_table((*head[:2], head[3]), [(*row[:2], row[3]) for row in rows])
    else:
        print_line(f"no peers on {channel.lighthouse}")
    _unlisted(drops)


def _unlisted(drops: Drops) -> int:
    """How many more agents are announced than are listed; says it to people."""
    if unlisted := drops.totals().get("presence", 0):
        click.echo(f"{plural(unlisted, 'more agent')} announced, beyond what is listed", err=True)
    return unlisted


def _status_json(how: RoleStatus | None) -> dict[str, Any] | None:
    """A status as it is on the wire."""
    return None if how is None else decode_json(how.encode())


@click.command("peers")
@with_json
@with_settings(NetworkSettings, "lighthouse_contract")
async def peers(settings: Settings, as_json: bool) -> None:
    """List the peers on the lighthouse's channel by role and address, and count the nodes on the IPFS side.

    Watchers are not listed. `aira status` shows the status of each peer.
    """
    from mesh.role.composition import watching
    from mesh.watching import BRIDGE, PROVIDER, present, statuses

    drops = Drops()
    async with watching(settings, drops=drops) as (network, channel):
        bridges = await present(channel, BRIDGE)
        found = await statuses(network.session, channel, bridges)
        peers = sorted({*await present(channel, PROVIDER), *bridges, *await present(channel)})
    states = [status for status in found.values() if isinstance(status, BridgeStatus)]
    # The count of the active bridge is used, or else of the one that sees most nodes.
    best = max(states, key=lambda how: (how.carries, len(how.ipfs_peers)), default=None)
    if as_json:
        listed = [{"role": peer.role, "address": peer.address} for peer in peers]
        nodes = None if best is None else list(best.ipfs_peers)
        about = {"lighthouse": channel.lighthouse, "peers": listed, "ipfsPeers": nodes}
        print_json(about | {"unlisted": _unlisted(drops)})
        return
    if peers:
        print_table(("role", "address"), [(peer.role, peer.address) for peer in peers])
    if best is None:
        nodes_there = "unknown, no bridge answers" if bridges else "unknown, there is no bridge"
    else:
        nodes_there = plural(len(best.ipfs_peers), "node")
        if best.state not in ("connected", "alone"):
            nodes_there += f"; the bridge reports: {printable(best.state)}"
    print_line(f"{plural(len(peers), 'peer')} on {channel.lighthouse}; IPFS side: {nodes_there}")
    _unlisted(drops)


PHASES: Final = ("incoming", "ready", "running", "complete")
"""The phases of open jobs."""


def describe_status(how: RoleStatus) -> dict[str, str]:
    """A status as names and texts. The texts come from others, so they are made printable."""
    facts = _describe_bridge(how) if isinstance(how, BridgeStatus) else _describe_participant(how)
    if how.dropped:
        facts["dropped"] = _counts(how.dropped)
    for reason, senders in how.heaviest.items():
        facts[f"most {reason}"] = ", ".join(f"{sender} {count:,}" for sender, count in senders.items())
    return {printable(name): printable(fact) for name, fact in facts.items()}


def summarize_status(how: RoleStatus | None) -> str:
    """A status in one line; None stands for a peer that did not answer."""
    if how is None:
        return "no answer"
    if isinstance(how, BridgeStatus):
        activity = "active" if how.carries else "standby"
        words = [how.state, activity, f"{plural(len(how.ipfs_peers), 'node')} on the IPFS side"]
    else:
        failures = [f"{part} {state}" for part, state in how.parts.items() if not is_healthy(state)]
        words = [*(failures or [ALIVE]), f"block {how.head:,}"]
        if how.work is not None:
            words.append(plural(sum(how.work.jobs.get(phase, 0) for phase in PHASES), "open job"))
        if how.market is not None:
            words += [plural(how.market.open_orders, "open order"), plural(how.market.created, "contract")]
        if how.validation is not None:
            cases = how.validation.cases
            words.append(plural(sum(cases.values()) - cases.get("ended", 0), "open case"))
    return printable(", ".join(words))


def _describe_participant(how: Status) -> dict[str, str]:
    facts: dict[str, str] = {
        how.role: how.address,
        "lighthouse": how.lighthouse,
        **how.parts,
        "block": f"{how.head:,} of chain {how.chain_id}",
    }
    facts |= {} if how.work is None else _describe_work(how.work)
    facts |= {} if how.market is None else _describe_market(how.market)
    facts |= {} if how.validation is None else _describe_validation(how.validation)
    uptime = format_duration(int(how.uptime) * 10**9)
    return facts | {"uptime": uptime, "version": how.version, "Zenoh id": how.zenoh_id}


def _describe_work(work: Work) -> dict[str, str]:
    open_jobs = ", ".join(f"{work.jobs[phase]:,} {phase}" for phase in PHASES if work.jobs.get(phase))
    return {
        "open jobs": open_jobs or "none",
        "done": f"{work.jobs.get('finalized', 0):,}",
        "to send": plural(work.outbox, "message"),
        "store": _describe_store(work.store),
    }


def _describe_store(store: StoreUse) -> str:
    room = "" if store.quota is None else f" of {format_size(store.quota)}"
    return f"{plural(store.files, 'file')}, {format_size(store.bytes)}{room}"


def _describe_validation(validation: ValidationStatus) -> dict[str, str]:
    cases = dict(validation.cases)
    ended = cases.pop("ended", 0)
    return {
        "judges for": ", ".join(validation.validators),
        "policies": ", ".join(validation.policies),
        "fee": XRT.show(validation.fee),
        "open cases": ", ".join(f"{count:,} {stage}" for stage, count in cases.items() if count) or "none",
        "done": f"{ended:,}",
        "store": _describe_store(validation.store),
    }


def _describe_market(market: MarketStatus) -> dict[str, str]:
    return {
        "open orders": f"{market.open_orders:,}",
        "contracts": f"{market.created:,} created, {market.finalized:,} finalized",
        "free contracts": f"{market.free_created:,}; {market.free_left:,} left now, of {market.free_a_day:,} a day",
        "rejected": _counts(market.rejected),
        "earned": f"{XRT.show(market.fees + market.minted)}, including {XRT.show(market.fees)} of fees",
        "spent": f"{ETH.show(market.spent)} for {market.gas_used:,} gas",
    }


def _describe_bridge(how: BridgeStatus) -> dict[str, str]:
    return {
        "bridge": parse_address(how.bridge),
        "lighthouse": how.lighthouse,
        "state": how.state,
        "active": "yes" if how.carries else "no, standby",
        "daemon": f"{how.daemon or 'not connected yet'} at {how.api}" + (f", {how.dialect}" if how.dialect else ""),
        "IPFS side": plural(len(how.ipfs_peers), "node"),
        "mesh side": plural(len(how.mesh_peers), "peer"),
        "to IPFS": _describe_direction(how.to_ipfs),
        "to mesh": _describe_direction(how.to_mesh),
        **({} if how.content is None else {"content": _describe_content(how.content)}),
        "daemon losses": f"{how.losses:,}",
        "last error": how.last_error or "none",
        "uptime": format_duration(int(how.uptime) * 10**9),
    }


def _describe_content(content: ContentMetrics) -> str:
    fetched = f"{plural(content.fetched, 'file')} fetched ({format_size(content.fetched_bytes)})"
    added = f"{content.added:,} added ({format_size(content.added_bytes)})"
    served = f"{plural(content.answered, 'block')} served, {content.lies:,} invalid ones rejected"
    queued = f"{content.adds_queued + content.fetches_queued:,} queued, {content.failed:,} failed"
    return f"{fetched}, {added}, {served}, {queued}"


def _describe_direction(direction: DirectionStatus) -> str:
    rejected = f", {_counts(direction.invalid)} rejected" if direction.invalid else ""
    return (
        f"{direction.carried:,} relayed ({direction.per_second:.1f}/s), {direction.waiting:,} waiting, "
        f"{_counts(direction.dropped)} dropped{rejected}"
    )


def _counts(counts: Mapping[str, int]) -> str:
    """The total, and the count of each kind."""
    kinds = ", ".join(f"{count:,} {kind}" for kind, count in sorted(counts.items()))
    return f"{sum(counts.values()):,}" + (f" ({kinds})" if kinds else "")
