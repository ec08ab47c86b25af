"""`aira replay`: publishes the messages of a recording again."""

from __future__ import annotations

import asyncio
import re
import time
from typing import TYPE_CHECKING, Any, Final, Protocol

import click
import zenoh
from msgspec import Struct

from mesh.cli.chain_client import open_chain, own_address
from mesh.cli.errors import AccountMissing, InvalidDestination, NoRecording, UnknownTopic
from mesh.cli.files import FETCH_SETTINGS, fetch, file_or_cid, opened_store, require_readable
from mesh.cli.options import with_json, with_settings
from mesh.cli.output import format_duration, plural, print_json, progress, said_by
from mesh.recording import GENEROUS, AtOnce, RecordedTimes, open_objective, play
from mesh.settings import ChainSettings, options_of
from schemas.agent_keys import DeviceTopicKey, LiabilityTopicKey, ObjectiveTopicKey, topic_chunks

if TYPE_CHECKING:
    from pathlib import Path

    from mesh.content import Store
    from mesh.recording import Objective, Pace, Played
    from mesh.settings import Settings


ROLES: Final = ("objective", "device", "agent")


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
@click.option(
    "--rate", type=click.FloatRange(min=0, min_open=True), default=1.0, show_default=True, help="speed factor"
)
@click.option("--at-once", is_flag=True, help="publish without pauses")
@click.option("--from", "start", type=click.FloatRange(min=0), default=0.0, help="skip this many seconds at the start")
@with_json
@with_settings(*dict.fromkeys((*FETCH_SETTINGS, *options_of(ChainSettings))))
async def command(settings: Settings, **options: Any) -> None:
    """Publish the messages of SOURCE again. SOURCE is a file, a CID, or the address of a liability with a recording.

    --to is the destination: `lamp` is that device of the account in --keyfile, `0x…/lamp` a device of another agent,
    and any other text with a slash (`lab/stage`) a key prefix to which the topics are appended. Without --to, the
    recording of a liability that has ended is published on its own topics.

    No contract is created and nothing is paid. Ctrl-C stops it.
    """
    await replay(settings, ReplayOptions(**options))


class ReplayOptions(Struct, frozen=True, kw_only=True):
    """The options of the command."""

    source: str
    to: str | None = None
    of_objective: bool = False
    topics: str | None = None
    role: str | None = None
    rate: float = 1.0
    at_once: bool = False
    start: float = 0.0
    as_json: bool = False

    @property
    def pace(self) -> Pace:
        """The pace of the playback."""
        return AtOnce() if self.at_once else RecordedTimes(speed=self.rate)

    def wants(self, message: Played, chosen: frozenset[str]) -> bool:
        """Whether to play a message; `chosen` are the topics, none for all."""
        return (not chosen or message.topic in chosen) and self.role in (None, message.role)


async def replay(settings: Settings, asked: ReplayOptions) -> None:
    from mesh.composition import endpoints_of
    from mesh.network import Network

    given = None if asked.to is None else await asyncio.to_thread(destination_of, settings, asked.to)
    async with opened_store(settings) as store:
        path, own = await _source(settings, store, asked)
        with progress(f"reading {path.name}") as tell:
            recording = await asyncio.to_thread(open_objective, path, GENEROUS, progress=tell)
        destination = given or own
        if destination is None:
            raise InvalidDestination("the destination is missing", hint="name a device or a key with --to")
        _check_topics(recording, destination, asked)
        async with Network(endpoints_of(settings)) as network:
            began = time.monotonic()
            played = await _play(network.session, recording, destination, asked)
        seconds = time.monotonic() - began
    if asked.as_json:
        print_json({"messages": played, "seconds": round(seconds, 3), "file": str(path)})
    else:
        click.echo(f"{plural(played, 'message')} in {format_duration(int(seconds * 1e9))}")


async def _source(settings: Settings, store: Store, asked: ReplayOptions) -> tuple[Path, Destination | None]:
    """The file to play, and its default destination."""
    if not ADDRESS.fullmatch(asked.source):
        named = file_or_cid(asked.source)
        return (await fetch(settings, store, named) if isinstance(named, str) else require_readable(named)), None
    async with open_chain(settings) as chain:
        liability = await chain.liabilities.get(asked.source)
    cid = liability.objective if asked.of_objective else liability.result
    if not cid:
        raise NoRecording(
            f"{liability.address} has no recording" + ("" if liability.is_finalized else " yet: it has not ended"),
            hint="publish its objective with --objective",
        )
    own = JobTopics(liability.promisor, liability.address) if liability.is_finalized else None
    return await fetch(settings, store, cid), own


def _check_topics(recording: Objective, destination: Destination, asked: ReplayOptions) -> None:
    """Check that every topic gives a valid key, before anything is sent. Raises `InvalidKey`, `UnknownTopic`."""
    chosen = _chosen(asked)
    known = {topic.name for topic in recording.topics}
    missing = sorted(chosen - known)
    if missing:
        raise UnknownTopic(
            f"the recording has no topic {', '.join(missing)}", hint=f"it has {', '.join(sorted(known)) or 'none'}"
        )
    for topic in chosen or known:
        destination.key(topic, "")


def _chosen(asked: ReplayOptions) -> frozenset[str]:
    return frozenset(name.strip() for name in (asked.topics or "").split(",") if name.strip())


async def _play(session: zenoh.Session, recording: Objective, destination: Destination, asked: ReplayOptions) -> int:
    """Publish each selected message when it is due; returns their number."""
    chosen, played = _chosen(asked), 0
    drop = zenoh.CongestionControl.DROP
    with progress("playing") as tell:
        async for step in play(recording, pace=asked.pace, start_ns=int(asked.start * 1e9)):
            message = step.message
            if asked.wants(message, chosen):
                encoding = message.type.zenoh_encoding
                session.put(
                    destination.key(message.topic, message.role),
                    message.payload,
                    encoding=encoding,
                    congestion_control=drop,
                )
                played += 1
            tell(step.index + 1, recording.count)
    return played


ADDRESS: Final = re.compile(r"0x[0-9a-fA-F]{40}")


class Destination(Protocol):
    """Where messages are published."""

    def key(self, topic: str, role: str) -> str:
        """The key for a topic; `role` is the message's role in the recording. Raises `InvalidKey`."""


class DeviceTopics(Struct, frozen=True):
    """The topics of a device, outside of jobs."""

    agent: str
    device: str

    def key(self, topic: str, role: str) -> str:
        """The device's topic."""
        return str(DeviceTopicKey(self.agent, self.device, topic))


class JobTopics(Struct, frozen=True):
    """The topics of a job that has ended."""

    agent: str
    liability: str

    def key(self, topic: str, role: str) -> str:
        """The key on which the message was recorded."""
        family = ObjectiveTopicKey if role == "objective" else LiabilityTopicKey
        return str(family(self.agent, self.liability, topic))


class KeyPrefix(Struct, frozen=True):
    """Keys that begin with `prefix`."""

    prefix: str

    def key(self, topic: str, role: str) -> str:
        """The device's topic."""
        return self.prefix + topic_chunks(topic)


def destination_of(settings: Settings, to: str) -> Destination:
    """The destination that `--to` names. Raises `InvalidDestination`, `InvalidKey`, `AccountMissing`."""
    first, slash, rest = to.partition("/")
    if not slash:
        own = own_address(settings)
        if own is None:
            raise AccountMissing(
                f"no account for the device {to!r}",
                hint="give --keyfile, or --to ADDRESS/DEVICE",
            )
        return _checked(DeviceTopics(own, to))
    if ADDRESS.fullmatch(first) and "/" not in rest:
        return _checked(DeviceTopics(first, rest))
    try:
        prefix = str(zenoh.KeyExpr(to))
    except zenoh.ZError as error:
        raise InvalidDestination(f"{to!r} is not a valid key prefix: {said_by(error)}") from None
    if "*" in prefix or "$" in prefix:
        raise InvalidDestination(f"{to!r} contains a wildcard", hint="give one key prefix")
    return KeyPrefix(prefix)


def _checked(device: DeviceTopics) -> DeviceTopics:
    """Return the device if its keys are valid. Raises `InvalidKey`."""
    device.key("/any", "")
    return device
