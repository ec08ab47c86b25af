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
from mesh.cli.files import MESH, fetch, file_or_cid, opened_store, require_readable
from mesh.cli.options import with_json, with_settings
from mesh.cli.output import format_duration, plural, print_json, progress
from mesh.errors import ConfigurationError, InputError
from mesh.recording import GENEROUS, AtOnce, RecordedTimes, open_objective, play
from mesh.running import run_to_end
from mesh.settings import ChainSettings, options_of
from schemas.key_chunks import topic_chunks
from schemas.keys import DeviceTopicKey, LiabilityTopicKey, ObjectiveTopicKey

if TYPE_CHECKING:
    from pathlib import Path

    from mesh.content import Store
    from mesh.recording import Objective, Pace, Played
    from mesh.settings import Settings


ROLES: Final = ("objective", "device", "agent")


@click.command("replay")
@click.argument("source")
@click.option("--to", metavar="DEVICE", help="a device of this account, ADDRESS/DEVICE, or the beginning of a key")
@click.option("--objective", "of_objective", is_flag=True, help="of a LIABILITY: its objective, not its recording")
@click.option("--topics", help="only these topics, separated by commas")
@click.option("--role", type=click.Choice(ROLES), help="only what was played, or what the device or the agent said")
@click.option(
    "--rate", type=click.FloatRange(min=0, min_open=True), default=1.0, show_default=True, help="how much faster"
)
@click.option("--at-once", is_flag=True, help="without the pauses")
@click.option("--from", "start", type=click.FloatRange(min=0), default=0.0, help="leave out so many seconds")
@with_json
@with_settings(*dict.fromkeys((*MESH, *options_of(ChainSettings))))
def command(settings: Settings, **options: Any) -> None:
    """Play SOURCE again onto keys of the mesh: a file, a CID, or the recording of a liability, by its address.

    --to says where: `lamp` is that device of the account in --keyfile, `0x…/lamp` one of another agent, and anything
    longer (`lab/stage`) the beginning of keys to which the topics are added. Without it, what a liability that has
    ended heard is said on its own topics again.

    No contract comes of it, and nobody is paid. Ctrl-C ends it.
    """
    run_to_end(lambda: _replay(settings, Replay(**options)))


class Replay(Struct, frozen=True, kw_only=True):
    """What was asked for."""

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
        """How fast."""
        return AtOnce() if self.at_once else RecordedTimes(speed=self.rate)

    def wants(self, message: Played, chosen: frozenset[str]) -> bool:
        """Whether a message is to be played; `chosen` are the topics, none for all."""
        return (not chosen or message.topic in chosen) and self.role in (None, message.role)


async def _replay(settings: Settings, asked: Replay) -> None:
    from mesh.composition import endpoints_of
    from mesh.network import Network

    given = None if asked.to is None else await asyncio.to_thread(destination_of, settings, asked.to)
    async with opened_store(settings) as store:
        path, own = await _source(settings, store, asked)
        with progress(f"reading {path.name}") as tell:
            recording = await asyncio.to_thread(open_objective, path, GENEROUS, progress=tell)
        destination = given or own
        if destination is None:
            raise InputError("a file says nothing of where it is to be played", hint="name a device or a key with --to")
        _check_topics(recording, destination, asked)
        async with Network(endpoints_of(settings)) as network:
            began = time.monotonic()
            played = await _play(network.session, recording, destination, asked)
        seconds = time.monotonic() - began
    if asked.as_json:
        print_json({"messages": played, "seconds": round(seconds, 3), "file": str(path)})
    else:
        click.echo(f"{plural(played, 'message')} in {format_duration(int(seconds * 1e9))}")


async def _source(settings: Settings, store: Store, asked: Replay) -> tuple[Path, Destination | None]:
    """The file to play, and where it is played unless something else is asked for."""
    if not ADDRESS.fullmatch(asked.source):
        named = file_or_cid(asked.source)
        return (await fetch(settings, store, named) if isinstance(named, str) else require_readable(named)), None
    async with open_chain(settings) as chain:
        liability = await chain.liabilities.get(asked.source)
    cid = liability.objective if asked.of_objective else liability.result
    if not cid:
        raise InputError(
            f"{liability.address} holds no recording" + ("" if liability.is_finalized else " yet: it has not ended"),
            hint="play its objective with --objective",
        )
    own = JobTopics(liability.promisor, liability.address) if liability.is_finalized else None
    return await fetch(settings, store, cid), own


def _check_topics(recording: Objective, destination: Destination, asked: Replay) -> None:
    """Make a key of every topic before the first message goes out. Raises `InvalidKey`, `InputError`."""
    chosen = _chosen(asked)
    there = {topic.name for topic in recording.topics}
    missing = sorted(chosen - there)
    if missing:
        raise InputError(
            f"the recording has no topic {', '.join(missing)}", hint=f"it has {', '.join(sorted(there)) or 'none'}"
        )
    for topic in chosen or there:
        destination.key(topic, "")


def _chosen(asked: Replay) -> frozenset[str]:
    return frozenset(name.strip() for name in (asked.topics or "").split(",") if name.strip())


async def _play(session: zenoh.Session, recording: Objective, destination: Destination, asked: Replay) -> int:
    """Put every message that is wanted when it is due; how many that were."""
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
    """Where messages go."""

    def key(self, topic: str, role: str) -> str:
        """The key for a topic, and the role that a message has there. Raises `InvalidKey` for what no key may hold."""


class DeviceTopics(Struct, frozen=True):
    """The topics of a device, outside any job."""

    agent: str
    device: str

    def key(self, topic: str, role: str) -> str:
        """Its topic."""
        return str(DeviceTopicKey(self.agent, self.device, topic))


class JobTopics(Struct, frozen=True):
    """The topics of a job that has ended."""

    agent: str
    liability: str

    def key(self, topic: str, role: str) -> str:
        """Where it was when it was recorded."""
        family = ObjectiveTopicKey if role == "objective" else LiabilityTopicKey
        return str(family(self.agent, self.liability, topic))


class KeyPrefix(Struct, frozen=True):
    """Keys that begin with `prefix`."""

    prefix: str

    def key(self, topic: str, role: str) -> str:
        """Its topic."""
        return self.prefix + topic_chunks(topic)


def destination_of(settings: Settings, to: str) -> Destination:
    """Where `--to` says. Raises `InputError`, `ConfigurationError`."""
    first, slash, rest = to.partition("/")
    if not slash:
        own = own_address(settings)
        if own is None:
            raise ConfigurationError(
                f"whose device {to!r} is can't be told without an account",
                hint="give --keyfile, or --to ADDRESS/DEVICE",
            )
        return _checked(DeviceTopics(own, to))
    if ADDRESS.fullmatch(first) and "/" not in rest:
        return _checked(DeviceTopics(first, rest))
    try:
        prefix = str(zenoh.KeyExpr(to))
    except zenoh.ZError as error:
        raise InputError(f"{to!r} is not the beginning of a key: {error}") from None
    if "*" in prefix or "$" in prefix:
        raise InputError(f"{to!r} has a wildcard, and would reach everybody", hint="name one key")
    return KeyPrefix(prefix)


def _checked(device: DeviceTopics) -> DeviceTopics:
    """The same, if keys can be made with it. Raises `InvalidKey`."""
    device.key("/any", "")
    return device
