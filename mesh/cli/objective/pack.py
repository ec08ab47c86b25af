"""`aira objective pack`."""

from __future__ import annotations

import asyncio
import sys
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO

import click

from mesh.cli.files import at_once, duration_words, free, size_words, unwritable
from mesh.cli.holdings import readable
from mesh.cli.options import with_settings
from mesh.cli.printing import plural, print_json, with_json
from mesh.cli.progress import progress
from mesh.errors import InputError
from mesh.recording import GENEROUS, bag_to_mcap, messages_in, open_objective, pack
from mesh.running import run_until_stopped
from mesh.settings import NetworkSettings, options_of
from schemas import cid_of_file

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    from mesh.settings import Settings

_BAG = b"#ROSBAG V"


@click.command("pack")
@click.argument("source", required=False, type=click.Path(path_type=Path, allow_dash=True))
@click.option("--out", required=True, type=click.Path(path_type=Path), help="MCAP file to write")
@click.option("--hear", "keys", multiple=True, metavar="KEY", help="record what is said on KEY (may be repeated)")
@click.option("--seconds", type=click.FloatRange(min=0, min_open=True), help="how long to hear [until Ctrl-C]")
@with_json
@with_settings(*options_of(NetworkSettings))
def command(
    settings: Settings, source: Path | None, out: Path, keys: tuple[str, ...], seconds: float | None, as_json: bool
) -> None:
    """Make an objective, an MCAP file, and print its CID.

    From SOURCE (`-`: the standard input): a ROS 1 bag, or JSON lines like

    \b
      {"topic": "/blink", "time": 0}
      {"topic": "/blink", "time": 0.5, "data": "blue"}
      {"topic": "/move", "time": 2, "data": {"x": 1.5}}

    `topic`; `time`, seconds from the beginning (left out: that of the line before); `data`: nothing is a
    std_msgs/Empty, a text a std_msgs/String, anything else JSON; `type`, where that is not meant: std_msgs/Empty,
    std_msgs/String, json, json;NAME, or any other encoding (`ros1;my_msgs/Move`), whose payload is then `data` in
    base64.

    Or from what is said in the mesh now, by --hear: `aira/agent/ADDRESS/device/lamp/**` is what a device says.
    """
    if (source is None) == (not keys):
        at_once(_refuse)
    if source is not None:
        at_once(lambda: _from_file(source, out, as_json=as_json))
    else:
        run_until_stopped(lambda: _hear(settings, keys, out, seconds=seconds, as_json=as_json))


def _refuse() -> None:
    raise InputError("an objective is made of a SOURCE or of what is heard", hint="name a file, or a key with --hear")


def _from_file(source: Path, out: Path, *, as_json: bool) -> None:
    free(out)
    try:
        with _opened(source) as stream, progress(f"packing {source.name}") as tell:
            if _is_bag(source):
                bag_to_mcap(source, out, cid=cid_of_file(source), limits=GENEROUS, progress=tell)
            else:
                total = source.stat().st_size if source.is_file() else None
                pack(messages_in(_told(stream, tell, total)), out)
    except OSError as error:
        raise unwritable(out, error) from None
    _print_made(out, as_json=as_json)


def _is_bag(source: Path) -> bool:
    """Whether a file begins as a ROS 1 bag does; what comes from the standard input are lines."""
    if not source.is_file():
        return False
    with source.open("rb") as stream:
        return stream.read(len(_BAG)) == _BAG


@contextmanager
def _opened(source: Path) -> Iterator[BinaryIO]:
    if str(source) == "-":
        yield sys.stdin.buffer
        return
    with readable(source).open("rb") as stream:
        yield stream


def _told(stream: BinaryIO, tell: Callable[[int, int | None], None], total: int | None) -> Iterator[bytes]:
    """The lines of a stream, of `total` bytes; `tell` is told how far it was read."""
    done = 0
    for line in stream:
        done += len(line)
        tell(done, total)
        yield line


async def _hear(settings: Settings, keys: Sequence[str], out: Path, *, seconds: float | None, as_json: bool) -> None:
    from mesh.cli.objective.hearing import hear, key_expression
    from mesh.composition import endpoints_of
    from mesh.network import Network

    expressions = [key_expression(key) for key in keys]
    free(out)
    async with Network(endpoints_of(settings)) as network:
        click.echo(f"hearing {', '.join(expressions)}; Ctrl-C ends it", err=True)
        try:
            with progress("hearing") as tell:
                total = None if seconds is None else int(seconds * 10)
                await hear(
                    network.session, expressions, out, seconds=seconds, tell=lambda done: tell(int(done * 10), total)
                )
        finally:
            await asyncio.to_thread(_print_if_made, out, as_json=as_json)


def _print_if_made(out: Path, *, as_json: bool) -> None:
    """What Ctrl-C has ended is a whole file, too."""
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
    length = duration_words(made.duration_ns)
    click.echo(f"{cid}  {out}  {plural(made.count, 'message')}, {length}, {size_words(made.size)}")
