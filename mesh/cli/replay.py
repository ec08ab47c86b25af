"""`aira replay`: publishes the messages of a recording again."""

from __future__ import annotations

import asyncio
import re
import time
from typing import TYPE_CHECKING, Any, Final, TypeAlias

import click
import zenoh

from mesh.cli.chain_client import open_chain, own_address
from mesh.cli.files import FETCH_SETTINGS, fetch, file_of, names_in, opened_store
from mesh.cli.options import FiniteRange, with_json, with_settings
from mesh.cli.output import format_duration, plural, print_result, progress, said_by
from mesh.errors import ConfigurationError, InputError
from mesh.recording import AT_ONCE, GENEROUS, open_objective, play
from mesh.settings import ChainSettings
from schemas.keys import DeviceTopicKey, LiabilityTopicKey, ObjectiveTopicKey, topic_chunks

if TYPE_CHECKING:
    from collections.abc import Callable, Collection
    from pathlib import Path

    from mesh.content import Store
    from mesh.recording import Objective
    from mesh.settings import Settings


ADDRESS: Final = re.compile(r"0x[0-9a-fA-F]{40}")
ROLES: Final = ("objective", "device", "agent")
Destination: TypeAlias = "Callable[[str, str], str]"
"""The key for a topic, and for the role that a message has in its recording. Raises `InvalidKey`."""


@click.command("replay")
@click.argument("source")
@click.option("--to", metavar="DEVICE", help="destination: a device of this account, ADDRESS/DEVICE, or a key prefix")
@click.option(
    "--objective", "of_objective", is_flag=True, help="for a liability: publish its objective instead of its recording"
)
@click.option("--topics", help="publish only these topics (separated by commas)")
@click.option(
    "--role", type=click.Choice(ROLES), help="publish only messages of the objective, the device or the agent"
)
@click.option("--rate", type=FiniteRange(1e-6, 1e6), default=1.0, show_default=True, help="speed factor")
@click.option("--at-once", is_flag=True, help="publish without pauses")
@click.option("--from", "start", type=FiniteRange(0, 1e9), default=0.0, help="skip this many seconds at the start")
@with_json
@with_settings(*FETCH_SETTINGS, ChainSettings)
async def command(
    settings: Settings,
    *,
    source: str,
    to: str | None,
    of_objective: bool,
    topics: str | None,
    role: str | None,
    rate: float,
    at_once: bool,
    start: float,
    as_json: bool,
) -> None:
    """Publish the messages of SOURCE again. SOURCE is a file, a CID, or the address of a liability with a recording.

    --to is the destination: `lamp` is that device of the account in --keyfile, `0x…/lamp` a device of another agent,
    and any other text with a slash (`lab/stage`) a key prefix to which the topics are appended. Without --to, the
    recording of a liability that has ended is published on its own topics. If nobody listens there, it says so.

    No contract is created and nothing is paid. Ctrl-C stops it.
    """
    from mesh.network import Endpoints, Network

    given = None if to is None else await asyncio.to_thread(destination_of, settings, to)
    chosen = names_in(topics or "")
    async with opened_store(settings) as store:
        path, own = await _source(settings, store, source, of_objective=of_objective)
        with progress(f"reading {path.name}") as tell:
            recording = await asyncio.to_thread(open_objective, path, GENEROUS, progress=tell)
        key_of = given or own
        if key_of is None:
            raise InputError(
                "the destination is missing", hint="name a device or a key with --to", code="invalid-destination"
            )
        _check_topics(recording, chosen)
        for topic in chosen or {topic.name for topic in recording.topics}:
            key_of(topic, "")  # raises before anything is sent if a topic gives no valid key
        steps = play(recording, speed=AT_ONCE if at_once else rate, start_ns=int(start * 1e9))
        began, played = time.monotonic(), 0
        async with Network(Endpoints.from_settings(settings)) as network:
            publishers: dict[str, Any] = {}
            with progress("playing") as tell:
                async for step in steps:
                    message = step.message
                    if (not chosen or message.topic in chosen) and role in (None, message.role):
                        key, encoding = key_of(message.topic, message.role), message.type.zenoh_encoding
                        if key not in publishers:
                            publishers[key] = network.session.declare_publisher(key)
                        drop = zenoh.CongestionControl.DROP
                        network.session.put(key, message.payload, encoding=encoding, congestion_control=drop)
                        played += 1
                    tell(step.index + 1, recording.count)
            seconds = time.monotonic() - began
            if publishers and not await _is_heard(publishers.values()):
                click.echo(f"aira: nobody listens on {', '.join(sorted(publishers))}", err=True)
    result = {"messages": played, "seconds": round(seconds, 3), "file": str(path)}
    shown = f"{plural(played, 'message')} in {format_duration(int(seconds * 1e9))}"
    print_result(result, shown, as_json=as_json)


async def _is_heard(publishers: Collection[Any]) -> bool:
    """Whether anybody listens to one of them, which the router says with some delay."""
    for _ in range(10):
        if any(publisher.matching_status.matching for publisher in publishers):
            return True
        await asyncio.sleep(0.1)
    return False


def _check_topics(recording: Objective, chosen: frozenset[str]) -> None:
    known = {topic.name for topic in recording.topics}
    if missing := sorted(chosen - known):
        raise InputError(
            f"the recording has no topic {', '.join(missing)}",
            hint=f"it has {', '.join(sorted(known)) or 'none'}",
            code="unknown-topic",
        )


async def _source(
    settings: Settings, store: Store, source: str, *, of_objective: bool
) -> tuple[Path, Destination | None]:
    """The file to play, and its default destination."""
    if not ADDRESS.fullmatch(source):
        return await file_of(settings, store, source), None
    async with open_chain(settings) as chain:
        liability = await chain.liabilities.get(source)
    cid = liability.objective if of_objective else liability.result
    if not cid:
        raise InputError(
            f"{liability.address} has no recording" + ("" if liability.is_finalized else " yet: it has not ended"),
            hint="publish its objective with --objective",
            code="no-recording",
        )

    def own(topic: str, role: str) -> str:
        """The key on which the message was recorded."""
        family = ObjectiveTopicKey if role == "objective" else LiabilityTopicKey
        return str(family(liability.promisor, liability.address, topic))

    return await fetch(settings, store, cid), own if liability.is_finalized else None


def destination_of(settings: Settings, to: str) -> Destination:
    """The destination that `--to` names. Raises `InputError`, `InvalidKey`, `ConfigurationError`."""
    first, slash, rest = to.partition("/")
    if not slash or (ADDRESS.fullmatch(first) and "/" not in rest):
        agent, device = (first, rest) if slash else (own_address(settings), to)
        if agent is None:
            raise ConfigurationError(
                f"no account for the device {to!r}",
                hint="give --keyfile, or --to ADDRESS/DEVICE",
                code="account-missing",
            )
        str(DeviceTopicKey(agent, device, "/any"))  # raises
        return lambda topic, role: str(DeviceTopicKey(agent, device, topic))
    try:
        prefix = str(zenoh.KeyExpr(to))
    except zenoh.ZError as error:
        raise InputError(f"{to!r} is not a valid key prefix: {said_by(error)}", code="invalid-destination") from None
    if "*" in prefix or "$" in prefix:
        raise InputError(f"{to!r} contains a wildcard", hint="give one key prefix", code="invalid-destination")
    return lambda topic, role: prefix + topic_chunks(topic)
