"""`aira status` and `aira peers`: the peers on a lighthouse's channel, and their status; `aira logs`: the log of one.
`aira health`: requests a server's health, as a container's health check does.
"""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING, Any, Final
from urllib.parse import urlsplit

import click

from mesh.amounts import ETH, XRT
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
    wait_for_broken_pipe,
)
from mesh.errors import ConfigurationError, RemoteError
from mesh.settings import NetworkSettings
from mesh.telemetry.metrics import Health, is_healthy, listen_address
from schemas import parse_address
from schemas.decoding import InvalidData, decode_json
from schemas.keys import DeviceTopicKey, RpcKey
from schemas.status import ALIVE, LEVELS, BridgeStatus, Status

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from mesh.base.flood import Drops
    from mesh.settings import Settings
    from mesh.watching import RoleStatus
    from mesh.watching.presence import LogReader, LogUpdate
    from schemas.status import ContentMetrics, DirectionStatus, LogEvent, MarketStatus, StoreUse, ValidationStatus, Work


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
    from mesh.base.flood import Drops
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
    from mesh.base.flood import Drops
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


LOOPBACK_OF: Final = {"0.0.0.0": "127.0.0.1", "::": "::1"}
"""The address at which to reach a server that listens on all interfaces."""


@click.command("health")
@click.option("--url", help="address of the server, http://HOST:PORT [the settings' metrics_listen]")
@with_timeout(8.0)
@with_json
@with_settings("metrics_listen")
def health(settings: Settings, url: str | None, timeout: float, as_json: bool) -> None:
    """Show the state of each part of a server that runs with --metrics-listen HOST:PORT.

    The exit code is 0 if all parts are alive, and 1 if one is not or the server does not answer, as container health
    checks expect.
    """
    found = _fetch_health(*_server_address(url, settings), timeout=timeout)
    if as_json:
        print_json(found)
    else:
        print_facts({printable(part): printable(state) for part, state in found.parts.items()})
    sys.exit(0 if found.ok else 1)


def _server_address(url: str | None, settings: Settings) -> tuple[str, int]:
    """Host and port of the server. Raises `ConfigurationError`."""
    if url is not None:
        try:
            parts = urlsplit(url)
            if parts.scheme == "http" and parts.hostname and parts.port:
                return parts.hostname, parts.port
        except ValueError:
            pass
        raise ConfigurationError(
            f"{url!r} is not a server address", hint="give --url http://HOST:PORT", code="invalid-server-address"
        )
    if not settings.metrics_listen:
        raise ConfigurationError(
            "the address of the server is missing",
            hint="give --url http://HOST:PORT, or the same metrics_listen as the server",
            code="invalid-server-address",
        )
    host, port = listen_address(settings.metrics_listen)
    return LOOPBACK_OF.get(host, host), port


def _fetch_health(host: str, port: int, *, timeout: float) -> Health:
    """The server's answer. Raises `RemoteError`."""
    from http.client import HTTPConnection, HTTPException

    connection = HTTPConnection(host, port, timeout=timeout)
    where = f"{host}:{port}"
    try:
        connection.request("GET", "/health")
        return Health.decode(connection.getresponse().read(65_536))
    except (OSError, HTTPException, UnicodeError) as error:
        why = getattr(error, "strerror", None) or str(error) or type(error).__name__
        raise RemoteError(
            f"no server answers at {where}: {why}",
            hint="check that the server runs with --metrics-listen HOST:PORT",
            code="health-unavailable",
        ) from None
    except InvalidData:
        raise RemoteError(
            f"the answer of the server at {where} is not a health report",
            hint="give the right --url",
            code="health-unavailable",
        ) from None
    finally:
        connection.close()


@click.command("logs")
@click.argument("address")
@click.option("--device", help="show the log of the edge agent that serves this device")
@click.option("--follow", "-f", is_flag=True, help="also show new events until Ctrl-C")
@click.option(
    "--lines", "-n", type=click.IntRange(min=0), default=100, show_default=True, help="number of past events to show"
)
@click.option(
    "--level", type=click.Choice(LEVELS[:-1]), default="debug", show_default=True, help="lowest level to show"
)
@click.option("--liability", default="", metavar="ADDRESS", help="show only events of this liability")
@with_timeout()
@with_json
@with_settings(NetworkSettings)
async def logs(
    settings: Settings,
    address: str,
    device: str | None,
    follow: bool,
    lines: int,
    level: str,
    liability: str,
    timeout: float,
    as_json: bool,
) -> None:
    """Show the latest log events of the agent, provider, validator or bridge with ADDRESS.

    Each keeps its last 2,000 events of its log_level or above. --json prints one object per line, in the format that
    log_format = "json" selects.
    """
    from mesh.base.background import Background
    from mesh.network import Endpoints, Network, no_answer
    from mesh.telemetry.logs import human_line, json_line
    from mesh.watching.presence import LogReader

    agent, line = parse_address(address), json_line if as_json else human_line
    wanted: dict[str, Any] = {"lines": lines, "level": level, "liability": liability and parse_address(liability)}
    # An edge agent serves its device's log on the topic `/log`.
    key = str(RpcKey(agent, "logs") if device is None else DeviceTopicKey(agent, device, "/log"))
    async with Network(Endpoints.from_settings(settings)) as network, Background() as tasks:
        tasks.start(wait_for_broken_pipe(), "readers of stdout")
        reader = LogReader(network.session, key, **wanted)
        update = await reader.poll(timeout=timeout)
        if not update.answered:
            raise no_answer(agent, "logs", device=device or "")
        _print_update(update, line)
        while update.more:
            update = await reader.poll(timeout=timeout)
            _print_update(update, line)
        if follow:
            await _follow(reader, line, timeout=timeout)


async def _follow(reader: LogReader, line: Callable[[LogEvent], str], *, timeout: float) -> None:
    """Show new events. Prints to stderr when it stops answering, and when it answers again."""
    import asyncio

    from mesh.network import ServiceFailed
    from mesh.watching.presence import LogUpdate

    reported = ""
    while True:
        await asyncio.sleep(0.5)
        try:
            update = await reader.poll(timeout=timeout)
            failure = "" if update.answered else "no answer; waiting"
        except ServiceFailed as error:
            update, failure = LogUpdate([]), printable(str(error))
        if failure != reported:
            _note(failure or "answering again")
            reported = failure
        _print_update(update, line)


def _print_update(update: LogUpdate, line: Callable[[LogEvent], str]) -> None:
    for began in update.began:
        _note(f"restarted at {printable(began)}")
    if update.missed:
        _note(f"missed {plural(update.missed, 'event')}: they arrived faster than they could be read")
    for event in update.events:
        print_line(line(event))


def _note(words: str) -> None:
    click.echo(f"aira: {words}", err=True)
