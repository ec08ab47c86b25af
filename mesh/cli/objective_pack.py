"""`aira objective pack`: creates an objective from JSON lines, a bag, or live messages."""

from __future__ import annotations

import asyncio
import logging
import sys
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

import click
import zenoh

import mesh
from mesh.cli.errors import InvalidDestination, InvalidOptions, NothingRecorded
from mesh.cli.files import require_new_file, require_readable, write_error
from mesh.cli.options import with_json, with_settings
from mesh.cli.output import format_duration, format_size, plural, print_json, progress, run_sync, said_by
from mesh.errors import InvalidKey
from mesh.log_context import log_event
from mesh.recording import GENEROUS, Recorder, RecordingAbout, bag_to_mcap, messages_in, open_objective, pack
from mesh.running import run_until_stopped
from mesh.settings import NetworkSettings, options_of
from schemas import cid_of_file
from schemas.agent_keys import DeviceTopicKey, LiabilityTopicKey, ObjectiveTopicKey
from schemas.keys import parse_key
from schemas.payloads import payload_type

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    from mesh.recording import RecordingSummary
    from mesh.settings import Settings

_BAG = b"#ROSBAG V"


@click.command("pack")
@click.argument("source", required=False, type=click.Path(path_type=Path, allow_dash=True))
@click.option("--out", required=True, type=click.Path(path_type=Path), help="MCAP file to write")
@click.option(
    "--hear", "keys", multiple=True, metavar="KEY", help="record the messages on this key expression (may be repeated)"
)
@click.option("--seconds", type=click.FloatRange(min=0, min_open=True), help="how long to record [until Ctrl-C]")
@with_json
@with_settings(*options_of(NetworkSettings))
def pack_objective(
    settings: Settings, source: Path | None, out: Path, keys: tuple[str, ...], seconds: float | None, as_json: bool
) -> None:
    """Create an objective, an MCAP file, and print its CID.

    SOURCE (`-` for standard input) is a ROS 1 bag, or JSON lines such as

    \b
      {"topic": "/blink", "time": 0}
      {"topic": "/blink", "time": 0.5, "data": "blue"}
      {"topic": "/move", "time": 2, "data": {"x": 1.5}}

    `time` is in seconds from the start; the default is the time of the previous line. `data` becomes a std_msgs/Empty
    if it is missing, a std_msgs/String if it is text, and JSON otherwise. `type` sets another type:
    std_msgs/Empty, std_msgs/String, json, json;NAME, or any other encoding (`ros1;my_msgs/Move`) with a base64 payload
    in `data`.

    --hear records live messages instead; `aira/agent/ADDRESS/device/lamp/**` selects those of a device.
    """
    if (source is None) == (not keys):
        run_sync(_refuse)
    if source is not None:
        run_sync(lambda: _from_file(source, out, as_json=as_json))
    else:
        run_until_stopped(lambda: _record(settings, keys, out, seconds=seconds, as_json=as_json))


def _refuse() -> None:
    raise InvalidOptions("give either SOURCE or --hear", hint="SOURCE is a file; --hear takes a key expression")


def _from_file(source: Path, out: Path, *, as_json: bool) -> None:
    require_new_file(out)
    try:
        with _opened(source) as stream, progress(f"packing {source.name}") as tell:
            if _is_bag(source):
                bag_to_mcap(source, out, cid=cid_of_file(source), limits=GENEROUS, progress=tell)
            else:
                total = source.stat().st_size if source.is_file() else None
                pack(messages_in(_lines_with_progress(stream, tell, total)), out)
    except OSError as error:
        raise write_error(out, error) from None
    _print_made(out, as_json=as_json)


def _is_bag(source: Path) -> bool:
    """Whether a file is a ROS 1 bag by its first bytes; standard input never is."""
    if not source.is_file():
        return False
    with source.open("rb") as stream:
        return stream.read(len(_BAG)) == _BAG


@contextmanager
def _opened(source: Path) -> Iterator[BinaryIO]:
    if str(source) == "-":
        yield sys.stdin.buffer
        return
    with require_readable(source).open("rb") as stream:
        yield stream


def _lines_with_progress(
    stream: BinaryIO, tell: Callable[[int, int | None], None], total: int | None
) -> Iterator[bytes]:
    """The lines of a stream of `total` bytes; `tell` is called with the bytes read so far."""
    done = 0
    for line in stream:
        done += len(line)
        tell(done, total)
        yield line


async def _record(settings: Settings, keys: Sequence[str], out: Path, *, seconds: float | None, as_json: bool) -> None:
    from mesh.composition import endpoints_of
    from mesh.network import Network

    expressions = [key_expression(key) for key in keys]
    require_new_file(out)
    async with Network(endpoints_of(settings)) as network:
        click.echo(f"recording {', '.join(expressions)}; Ctrl-C stops it", err=True)
        try:
            with progress("recording") as tell:
                total = None if seconds is None else int(seconds * 10)
                await record_keys(
                    network.session, expressions, out, seconds=seconds, tell=lambda done: tell(int(done * 10), total)
                )
        finally:
            await asyncio.to_thread(_print_if_made, out, as_json=as_json)


def _print_if_made(out: Path, *, as_json: bool) -> None:
    """Print the recording even if Ctrl-C stopped it: the file is complete."""
    if out.exists():
        _print_made(out, as_json=as_json)


def _print_made(out: Path, *, as_json: bool) -> None:
    made, cid = open_objective(out, GENEROUS), cid_of_file(out)
    if as_json:
        print_json(
            {
                "cid": cid,
                "file": str(out),
                "size": made.size,
                "messages": made.count,
                "topics": sorted({topic.name for topic in made.topics}),
                "durationNs": made.duration_ns,
            }
        )
        return
    length = format_duration(made.duration_ns)
    click.echo(f"{cid}  {out}  {plural(made.count, 'message')}, {length}, {format_size(made.size)}")


log = logging.getLogger(__name__)


PROGRESS_INTERVAL = 0.1
"""Seconds between two updates of the progress bar."""


def key_expression(text: str) -> str:
    """Return the text if it is a key expression. Raises `InvalidDestination`."""
    try:
        return str(zenoh.KeyExpr(text))
    except zenoh.ZError as error:
        raise InvalidDestination(
            f"{text!r} is not a key expression: {said_by(error)}",
            hint="`*` matches one chunk, `**` any number of chunks",
        ) from None


def topic_of(key: str) -> str:
    """The topic in the key of a device or a job; for any other key, the whole key."""
    try:
        parsed = parse_key(key)
    except InvalidKey:
        return f"/{key}"
    if isinstance(parsed, DeviceTopicKey | LiabilityTopicKey | ObjectiveTopicKey):
        return parsed.topic
    return f"/{key}"


async def record_keys(
    session: zenoh.Session,
    keys: Sequence[str],
    target: Path,
    *,
    seconds: float | None = None,
    tell: Callable[[float], None] = lambda done: None,
) -> RecordingSummary:
    """Record the messages on `keys` to a new file for `seconds`, or until cancelled. The file is complete either way.

    `tell` is called with the seconds so far. Raises `RecordingFailed`, and `NothingRecorded`, which leaves no file.
    """
    about = RecordingAbout(software=f"aira-mesh {mesh.__version__}")
    recorder = await asyncio.to_thread(Recorder, target, about)

    def record_sample(sample: zenoh.Sample) -> None:
        try:
            kind = payload_type(str(sample.encoding))
            recorder.record(topic_of(str(sample.key_expr)), sample.payload.to_bytes(), kind)
        except Exception as error:  # Zenoh ignores what its callbacks raise
            fields = log_event("message-unrecorded", key=str(sample.key_expr))
            log.warning("a message on %s was not recorded: %s", sample.key_expr, error, extra=fields)

    subscribers: list[Any] = []
    try:
        subscribers.extend(session.declare_subscriber(key, record_sample) for key in keys)
        await _pass_time(seconds, tell)
    finally:
        for subscriber in subscribers:
            subscriber.undeclare()
        summary = await asyncio.to_thread(recorder.close)
        if not summary.messages:
            await asyncio.to_thread(target.unlink)
    if not summary.messages:
        raise NothingRecorded(
            f"no message arrived on {', '.join(keys)}",
            hint="`aira/agent/ADDRESS/device/**` selects the devices of an agent",
        )
    return summary


async def _pass_time(seconds: float | None, tell: Callable[[float], None]) -> None:
    loop = asyncio.get_running_loop()
    begin = loop.time()
    while seconds is None or loop.time() - begin < seconds:
        left = PROGRESS_INTERVAL if seconds is None else min(PROGRESS_INTERVAL, seconds - (loop.time() - begin))
        await asyncio.sleep(max(0, left))
        tell(loop.time() - begin)
