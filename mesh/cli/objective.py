"""`aira objective`: creates, shows, plots, checks, converts, recovers and fetches objectives and recordings."""

from __future__ import annotations

import asyncio
import logging
import math
import sys
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO, Final, Literal, NamedTuple

import click
import zenoh

import mesh
from mesh.base.extras import needs_extra
from mesh.base.log_context import log_event
from mesh.cli import LazyGroup
from mesh.cli.files import (
    FETCH_SETTINGS,
    STORE_SETTINGS,
    account_store,
    fetch,
    file_or_cid,
    names_in,
    opened_store,
    require_new_file,
    require_readable,
    writing,
)
from mesh.cli.options import PATH, SECONDS, with_json, with_settings
from mesh.cli.output import (
    BAR_INTERVAL,
    format_duration,
    format_size,
    interruptible,
    json_text,
    plural,
    print_facts,
    print_json,
    print_line,
    print_result,
    print_table,
    printable,
    progress,
    said_by,
)
from mesh.errors import InputError, InvalidKey, RemoteError
from mesh.recording import (
    GENEROUS,
    Limits,
    Objective,
    Recorder,
    RecordingAbout,
    RecordingFormat,
    TopicRates,
    convert,
    is_bag,
    messages_in,
    numbers_of,
    open_objective,
    pack,
    preflight,
    rates_of,
    recording_file,
    recording_files,
    recover,
)
from mesh.role.running import report, run_to_end, run_until_stopped
from mesh.settings import NetworkSettings
from schemas import cid_of_file
from schemas.keys import DeviceTopicKey, LiabilityTopicKey, ObjectiveTopicKey, parse_key
from schemas.payloads import payload_type

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Sequence

    from mesh.agent.objectives import ObjectiveUnfit
    from mesh.content import Store
    from mesh.recording import Played, RecordingSummary
    from mesh.recording.objective import Preflight
    from mesh.settings import Settings
    from schemas.payloads import PayloadType


log = logging.getLogger(__name__)

LIMIT_SETTINGS: Final = {"size": "objective_size_limit", "expanded": "objective_expanded_limit"}
"""The settings for fields of `Limits`."""
CHECK_SETTINGS: Final = (*STORE_SETTINGS, *LIMIT_SETTINGS.values())
_FORMATS: Final[dict[str, RecordingFormat]] = {".mcap": "mcap", ".bag": "bag"}
PIN: Final = "user"
"""The pin of files that a user added; they are never evicted."""


command = LazyGroup(
    "objective",
    help="Create, show, check and fetch objectives and recordings: MCAP files (or ROS 1 bags) of a robot's messages.",
)


@command.command("add", short_help="add files to the store, from which robots fetch them")
@click.argument("files", nargs=-1, required=True, type=PATH)
@with_json
@with_settings(*CHECK_SETTINGS)
@interruptible
def add(settings: Settings, files: tuple[Path, ...], as_json: bool) -> None:
    """Add FILES to the store of the account in --keyfile, and print their CIDs. Without --keyfile they go to a store
    that commands read, but no agent serves.

    Others can fetch the files by CID while an agent of that account runs. Files that robots would refuse are added,
    too, but the exit code is 2.
    """
    files = tuple(require_readable(recording_file(path)) for path in files)
    if not settings.keyfile:
        click.echo("no agent serves the store of no account; --keyfile FILE selects that of yours", err=True)
    added, refused = [], []
    with account_store(settings) as store:
        for path in files:
            with progress(f"adding {path.name}") as tell:
                cid = store.put_file(path, pin=PIN, progress=tell)
            with progress(f"examining {path.name}") as tell:
                outcome = preflight(path, Limits.of(settings), progress=tell)
            if not outcome.ok:
                refused.append(_unfit(cid, outcome))
            added.append({"cid": cid, "file": str(path), "reason": outcome.reason})
            if not as_json:
                click.echo(cid if len(files) == 1 else f"{cid}  {path}")
    if as_json:
        print_json(added)
    for error in refused:
        report(error)
    if refused:
        raise SystemExit(2)


def _unfit(cid: str, outcome: Preflight) -> ObjectiveUnfit:
    """The error for a file that robots would refuse; its hint names the setting of the limit that it exceeds."""
    from mesh.agent.objectives import ObjectiveUnfit

    setting = LIMIT_SETTINGS.get(outcome.limit)
    hint = f"robots with a higher {setting} take it" if setting else ""
    return ObjectiveUnfit(cid, outcome.reason, printable(outcome.detail), hint=hint)


@command.command("get", short_help="fetch a file by its CID")
@click.argument("cid")
@click.option("--out", required=True, type=PATH, help="file to write")
@with_json
@with_settings(*FETCH_SETTINGS)
async def get(settings: Settings, cid: str, out: Path, as_json: bool) -> None:
    """Fetch the file with this CID from the store or the mesh, and verify every block."""
    require_new_file(out)
    async with opened_store(settings) as store:
        await fetch(settings, store, cid)
        with writing(out), progress(f"writing {out.name}") as tell:
            size = (await asyncio.to_thread(store.copy, cid, out, progress=tell)).stat().st_size
    print_result({"cid": cid, "file": str(out), "size": size}, f"{out}  {format_size(size)}", as_json=as_json)


@command.command("check", short_help="check whether a robot would accept it, or check the whole store")
@click.argument("objective", required=False)
@click.option("--topics", help="topics that the robot accepts, separated by commas [any]")
@with_json
@with_settings(*CHECK_SETTINGS)
@interruptible
def check(settings: Settings, objective: str | None, topics: str | None, as_json: bool) -> None:
    """Check OBJECTIVE, a file or a CID in the store, as a robot does before it accepts a job: the format, the size and
    expanded size, all checksums, the schemas and the topics.

    Without OBJECTIVE, check every file of the store against its CID. The exit code is 1 if a check fails. The printed
    reason is a stable code.
    """
    with account_store(settings) as store:
        if objective is None:
            is_fine = _check_store(store, as_json=as_json)
        else:
            is_fine = _check(settings, store, objective, topics=topics, as_json=as_json)
    if not is_fine:
        raise SystemExit(1)


def _check(settings: Settings, store: Store, objective: str, *, topics: str | None, as_json: bool) -> bool:
    named = file_or_cid(objective)
    if isinstance(named, str):
        with progress(f"hashing {named[:8]}…") as tell:
            path, cid = store.verify(named, progress=tell), named
    else:
        path = require_readable(recording_file(named))
        cid = cid_of_file(path)
    with progress(f"reading {path.name}") as tell:
        taken = None if topics is None else names_in(topics)
        outcome = preflight(path, Limits.of(settings), topics=taken, progress=tell)
    result = {"cid": cid, "file": str(path), "ok": outcome.ok, "reason": outcome.reason, "detail": outcome.detail}
    shown = f"{outcome.reason}: {printable(outcome.detail)}"
    if outcome.ok and outcome.objective is not None:
        length = format_duration(outcome.objective.duration_ns)
        shown = f"valid: {plural(outcome.objective.count, 'message')}, {length}"
    print_result(result, f"{cid}  {shown}", as_json=as_json)
    return outcome.ok


def _check_store(store: Store, *, as_json: bool) -> bool:
    with progress("checking the store") as tell:
        check = store.check(progress=tell)
    if as_json:
        print_json({"files": check.files, "bytes": check.bytes, "damaged": list(check.damaged)})
    else:
        click.echo(f"{plural(check.files, 'file')}, {format_size(check.bytes)}, {len(check.damaged)} damaged")
        for cid in check.damaged:
            click.echo(f"{cid}  damaged and moved aside; fetch it again")
    return not check.damaged


@command.command("convert", short_help="convert between MCAP, ROS 1 bags and rosbag2")
@click.argument("source", type=PATH)
@click.argument("out", type=PATH, required=False)
@click.option(
    "--storage",
    type=click.Choice(["mcap", "sqlite3"]),
    default="mcap",
    show_default=True,
    help="storage of a folder of rosbag2",
)
@click.option("--topic", "topics", multiple=True, help="only topics of this pattern (/camera/*); may be repeated [all]")
@click.option("--leave-out", is_flag=True, help="leave out topics that can't be converted, instead of refusing")
@click.option(
    "--distribution",
    default="jazzy",
    show_default=True,
    help="ROS 2 distribution with the types that SOURCE leaves out",
)
@with_json
@interruptible
def convert_recording(
    source: Path,
    out: Path | None,
    storage: Literal["mcap", "sqlite3"],
    topics: tuple[str, ...],
    leave_out: bool,
    distribution: str,
    as_json: bool,
) -> None:
    """Convert SOURCE, an MCAP file, a ROS 1 bag, or a file or folder of rosbag2, to OUT [SOURCE with the suffix .mcap],
    and print the CID of the file.

    OUT is an MCAP file if its name ends with .mcap, a ROS 1 bag with .bag, and else a folder of rosbag2. To MCAP
    everything is kept: payloads, types, times, topics and connection headers. Bags and rosbag2 hold ROS messages only;
    other topics are named."""
    out = out or source.with_suffix(".mcap")
    of: RecordingFormat = "rosbag2-mcap" if storage == "mcap" else "rosbag2-sqlite3"
    to = _FORMATS.get(out.suffix, of)
    files = [require_readable(path) for path in recording_files(source)]
    require_new_file(out)
    cid = ",".join(map(cid_of_file, files))
    with writing(out), progress(f"converting {source.name}") as tell:
        done = convert(
            source, out, to=to, cid=cid, topics=topics, leave_out=leave_out, distribution=distribution, progress=tell
        )
    made = cid_of_file(done.path)
    if as_json:
        written = {"messages": done.messages, "durationNs": done.duration_ns, "leftOut": done.left_out}
        print_json({"cid": made, "file": str(done.path), "source": cid, **written})
        return
    click.echo(f"{made}  {done.path}  {plural(done.messages, 'message')}, {format_duration(done.duration_ns)}")
    for topic, why in done.left_out.items():
        click.echo(f"left out: {printable(topic)}: {printable(why)}", err=True)


@command.command("recover", short_help="save the readable part of a damaged file")
@click.argument("file", type=PATH)
@click.option("--out", type=PATH, help="file to write [NAME.recovered.mcap]")
@with_json
@interruptible
def recover_file(file: Path, out: Path | None, as_json: bool) -> None:
    """Write the readable part of FILE, an MCAP file or ROS 1 bag, to a new MCAP file that says what is missing."""
    require_readable(file)
    if out is not None:
        require_new_file(out)
    with writing(out or file.parent):
        recovered = recover(file, out)
    cid = cid_of_file(recovered.path)
    if as_json:
        found = {"messages": recovered.messages, "why": recovered.why}
        print_json({"cid": cid, "file": str(recovered.path), **found})
        return
    click.echo(f"{cid}  {recovered.path}  {plural(recovered.messages, 'message')}")
    click.echo(f"missing: {printable(recovered.why) or 'nothing'}")


class PlotLimits(NamedTuple):
    """What is drawn of a recording."""

    topics: int = 8
    """Topics whose numbers are drawn, each in axes of its own."""
    lines: int = 12
    """Lines of a topic."""
    points: int = 20_000
    """Points of a line; of more, every second is left out, again and again."""
    number: float = 1e100
    """Numbers from here on can't be drawn: matplotlib reckons with their differences."""


PLOT_LIMITS: Final = PlotLimits()


class Line:
    """A number of a topic over time: seconds from the first message, and the values there."""

    def __init__(self) -> None:
        self.seconds: list[float] = []
        self.values: list[float] = []
        self._seen = 0
        self._every = 1

    def add(self, seconds: float, value: float) -> None:
        """Add the next point, unless it is one of those that are left out."""
        if self._seen % self._every == 0:
            self.seconds.append(seconds)
            self.values.append(value if abs(value) < PLOT_LIMITS.number else math.nan)  # which is drawn as a gap
            if len(self.values) > PLOT_LIMITS.points:
                self.seconds, self.values, self._every = self.seconds[::2], self.values[::2], 2 * self._every
        self._seen += 1


def lines_of(messages: Iterable[Played], *, start_ns: int) -> dict[str, dict[str, Line]]:
    """The lines of each topic with numbers, by the names of their fields (empty for a number alone).

    Those beyond `PLOT_LIMITS` are left out.
    """
    topics: dict[str, dict[str, Line]] = {}
    for message in messages:
        if message.topic not in topics and len(topics) == PLOT_LIMITS.topics:
            continue
        for name, number in numbers_of(message):
            lines = topics.setdefault(message.topic, {})
            if name in lines or len(lines) < PLOT_LIMITS.lines:
                lines.setdefault(name, Line()).add((message.log_time_ns - start_ns) / 1e9, number)
    return topics


def draw(objective: Objective, rates: TopicRates, path: Path) -> None:
    """Plot the numbers of each topic, and the messages per second of all, to a PNG at `path`.

    Raises `PackageMissing`, `ConfigurationError`.
    """
    with needs_extra("plot", "--png"):
        from matplotlib.figure import Figure
    topics = lines_of(objective.messages(), start_ns=objective.start_ns)
    figure = Figure(figsize=(10, 3 * (len(topics) + 1)), layout="constrained")
    all_axes = figure.subplots(len(topics) + 1, 1, sharex=True, squeeze=False)[:, 0]
    for axes, (topic, lines) in zip(all_axes, topics.items(), strict=False):
        for name, line in lines.items():
            axes.plot(line.seconds, line.values, marker=".", label=_plain_text(name.lstrip(".")))
        axes.set(ylabel=_plain_text(topic))
        if any(lines):
            axes.legend(loc="upper right", fontsize="small")
    _draw_rates(all_axes[-1], rates)
    figure.suptitle(_plain_text(objective.path.name))
    with writing(path):
        figure.savefig(path, format="png", dpi=100)


def _draw_rates(axes: Any, rates: TopicRates) -> None:
    spans = len(next(iter(rates.counts.values()), []))
    edges = [number * rates.span_ns / 1e9 for number in range(spans + 1)]
    for topic in sorted(rates.counts):
        axes.stairs(rates.per_second(topic), edges, label=_plain_text(topic))
    axes.set(xlabel="seconds from the first message", ylabel="messages per second")
    axes.set_ylim(bottom=0)
    if rates.counts:
        axes.legend(loc="upper right", fontsize="small")


def _plain_text(text: str) -> str:
    """Text from others for matplotlib, where a dollar starts a formula and a leading underscore hides a label."""
    return printable(text).replace("$", r"\$").lstrip("_")


def print_messages(path: Path, topics: frozenset[str], *, as_json: bool) -> None:
    """Print the messages on these topics (none given: on all). Raises `RecordingError`."""
    objective = open_objective(path, GENEROUS)
    for message in objective.messages():
        if topics and message.topic not in topics:
            continue
        value, kind = message.value, message.type
        if as_json:
            facts = {"timeNs": message.log_time_ns, "topic": message.topic, "type": kind.zenoh_encoding}
            facts |= {"role": message.role, "base64" if isinstance(value, bytes) else "value": value}
            print_json(facts)
        else:
            text = json_text(value)
            if isinstance(value, bytes):
                first = value[:32]
                shown = first.hex(" ") + (" …" if len(first) < len(value) else "")
                text = f"{kind.schema_name or kind.encoding or 'bytes'}, {len(value)} bytes: {shown}"
            seconds = (message.log_time_ns - objective.start_ns) / 1e9
            role = f" ({printable(message.role)})" if message.role else ""
            print_line(f"{seconds:10.3f} s  {printable(message.topic)}{role}  {printable(text)}")


SPANS: Final = 48
"""Columns of the plot in the terminal."""
BARS: Final = " ▁▂▃▄▅▆▇█"


@command.command("show", short_help="show the summary, topics, schemas and message times")
@click.argument("objective")
@click.option("--schemas", is_flag=True, help="also print the schema of each type")
@click.option("--png", type=PATH, help="also plot the numbers in the messages to this PNG file")
@click.option("--messages", is_flag=True, help="print the messages instead, as `aira objective cat` does")
@click.option("--topic", "topics", multiple=True, help="print only messages on this topic; may be repeated")
@with_json
@with_settings(*FETCH_SETTINGS)
@interruptible
def show(
    settings: Settings,
    objective: str,
    schemas: bool,
    png: Path | None,
    messages: bool,
    topics: tuple[str, ...],
    as_json: bool,
) -> None:
    """Show the content of OBJECTIVE, a file or a CID: its duration, topics, types, metadata, and the times of its
    messages; or, with --messages or --topic, the messages."""
    path = local_file(settings, objective)
    if messages or topics:
        print_messages(path, frozenset(topics), as_json=as_json)
        return
    with progress(f"reading {path.name}") as tell:
        found = open_objective(path, GENEROUS, progress=tell)
    if png is not None:
        draw(found, _rates(found, 200), png)
    if as_json:
        print_json(_objective_json(found))
        return
    _print_summary(found)
    _print_topics(found)
    if schemas:
        _print_schemas(found)


@command.command("cat", short_help="print the messages")
@click.argument("objective")
@click.option("--topic", "topics", multiple=True, help="only messages on this topic; may be repeated [all topics]")
@with_json
@with_settings(*FETCH_SETTINGS)
@interruptible
def cat(settings: Settings, objective: str, topics: tuple[str, ...], as_json: bool) -> None:
    """Print the messages of OBJECTIVE, a file or a CID: seconds since its first message, topic, value. --json prints
    an object for each; bytes are in `base64` there."""
    print_messages(local_file(settings, objective), frozenset(topics), as_json=as_json)


def local_file(settings: Settings, objective: str) -> Path:
    """The file that a user named, or the one with that CID, fetched if needed. Exits if that fails."""
    path = file_or_cid(objective)

    async def main() -> None:
        nonlocal path
        if isinstance(path, str):
            async with opened_store(settings) as store:
                path = await fetch(settings, store, path)

    if isinstance(path, str):
        run_to_end(main)
    assert isinstance(path, Path)
    return require_readable(recording_file(path))


def _rates(objective: Objective, spans: int) -> TopicRates:
    start, duration = objective.start_ns, objective.duration_ns
    return rates_of(objective.messages(), start_ns=start, duration_ns=duration, spans=spans)


def _objective_json(objective: Objective) -> dict[str, Any]:
    rates, topics = _rates(objective, SPANS), []
    for name, kinds in _kinds(objective).items():
        types = [
            {
                "type": kind.zenoh_encoding,
                "schemaEncoding": kind.schema_encoding,
                "schema": kind.schema_data.decode(errors="replace"),
            }
            for kind in kinds
        ]
        topics.append({"topic": name, "messages": sum(rates.counts.get(name, ())), "types": types})
    return {
        "cid": cid_of_file(objective.path),
        "file": str(objective.path),
        "format": objective.format,
        "size": objective.size,
        "messages": objective.count,
        "startNs": objective.start_ns,
        "durationNs": objective.duration_ns,
        "topics": topics,
        "metadata": objective.metadata,
        "attachments": [
            {"name": one.name, "mediaType": one.media_type, "size": one.size} for one in objective.attachments
        ],
        "spanNs": rates.span_ns,
        "counts": rates.counts,
    }


def _kinds(objective: Objective) -> dict[str, list[PayloadType]]:
    """The types of each topic, usually one."""
    kinds: dict[str, list[PayloadType]] = {}
    for topic in objective.topics:
        kinds.setdefault(topic.name, []).append(topic.type)
    return kinds


def _print_summary(objective: Objective) -> None:
    attached = ", ".join(f"{printable(one.name)} ({format_size(one.size)})" for one in objective.attachments)
    print_facts(
        {
            "cid": cid_of_file(objective.path),
            "format": {"mcap": "MCAP", "bag": "ROS 1 bag", "sqlite3": "rosbag2 (sqlite3)"}[objective.format],
            "size": format_size(objective.size),
            "messages": f"{objective.count:,}",
            "duration": format_duration(objective.duration_ns),
            "attached": attached or None,
        }
    )
    for name, values in objective.metadata.items():
        click.echo(f"\n{printable(name)}")
        print_facts({f"  {printable(key)}": printable(value) for key, value in values.items()})


def _print_topics(objective: Objective) -> None:
    rates = _rates(objective, SPANS)
    rows = []
    for name, kinds in _kinds(objective).items():
        counts = rates.counts.get(name, [])
        rate = f"{sum(counts) * 1e9 / objective.duration_ns:.3g}/s" if objective.duration_ns else ""
        types = ", ".join(printable(kind.schema_name or kind.encoding or "bytes") for kind in kinds)
        rows.append((printable(name), types, f"{sum(counts):,}", rate, _bars(counts)))
    click.echo()
    print_table(("topic", "type", "messages", "rate", "when"), rows, numbers=("messages", "rate"))
    if objective.duration_ns:
        click.echo(f"each column of `when` stands for {format_duration(rates.span_ns)}")


def _bars(counts: Sequence[int]) -> str:
    """A bar for each count, the highest one full; a bar is empty only for 0."""
    most = max(counts, default=0)
    return "".join(BARS[-(-count * (len(BARS) - 1) // most)] if count else " " for count in counts)


def _print_schemas(objective: Objective) -> None:
    for kind in dict.fromkeys(topic.type for topic in objective.topics):
        click.echo(f"\n{printable(kind.zenoh_encoding)} ({plural(len(kind.schema_data), 'byte')} of schema)")
        for line in kind.schema_data.decode(errors="replace").splitlines():
            click.echo(f"  {printable(line.expandtabs())}")


@command.command("pack", short_help="create one from JSON lines, a bag, or live messages")
@click.argument("source", required=False, type=click.Path(path_type=Path, allow_dash=True))
@click.option("--out", required=True, type=PATH, help="MCAP file to write")
@click.option(
    "--hear", "keys", multiple=True, metavar="KEY", help="record the messages on this key expression (may be repeated)"
)
@click.option("--seconds", type=SECONDS, help="how long to record [until Ctrl-C]")
@with_json
@with_settings(NetworkSettings)
def pack_objective(
    settings: Settings, source: Path | None, out: Path, keys: tuple[str, ...], seconds: float | None, as_json: bool
) -> None:
    """Create an objective, an MCAP file, and print its CID.

    SOURCE (`-` for standard input) is a ROS 1 bag, or JSON lines such as

    \b
      {"topic": "/blink", "time": 0}
      {"topic": "/blink", "time": 0.5, "value": "blue"}
      {"topic": "/move", "time": 2, "value": {"x": 1.5}}

    `time` is in seconds from the start; the default is the time of the previous line. `value` becomes a std_msgs/Empty
    if it is missing, a std_msgs/String if it is text, and JSON otherwise. `type` sets another type:
    std_msgs/Empty, std_msgs/String, json, json;NAME, or any other encoding (`ros1;my_msgs/Move`) with a base64 payload
    in `value`.

    --hear records live messages instead; `aira/agent/ADDRESS/device/lamp/**` selects those of a device.
    """
    if (source is None) == (not keys):
        hint = "SOURCE is a file; --hear takes a key expression"
        raise InputError("give either SOURCE or --hear", hint=hint, code="invalid-options")
    if source is not None:
        _from_file(source, out, as_json=as_json)
    else:
        run_until_stopped(lambda: _record(settings, keys, out, seconds=seconds, as_json=as_json))


@interruptible
def _from_file(source: Path, out: Path, *, as_json: bool) -> None:
    require_new_file(out)
    with writing(out), _opened(source) as stream, progress(f"packing {source.name}") as tell:
        if is_bag(source):
            convert(source, out, to="mcap", cid=cid_of_file(source), progress=tell)
        else:
            total = source.stat().st_size if source.is_file() else None
            pack(messages_in(_lines_with_progress(stream, tell, total)), out)
    _print_made(out, as_json=as_json)


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
    from mesh.network import Endpoints, Network

    expressions = [key_expression(key) for key in keys]
    require_new_file(out)
    async with Network(Endpoints.from_settings(settings)) as network:
        click.echo(f"recording {', '.join(expressions)}; Ctrl-C stops it", err=True)
        try:
            with progress("recording") as tell:
                total = None if seconds is None else int(seconds * 10)
                await record_keys(
                    network.session, expressions, out, seconds=seconds, tell=lambda done: tell(int(done * 10), total)
                )
        finally:
            if await asyncio.to_thread(out.exists):  # it is complete, even if Ctrl-C stopped it
                await asyncio.to_thread(_print_made, out, as_json=as_json)


def _print_made(out: Path, *, as_json: bool) -> None:
    made, cid = open_objective(out, GENEROUS), cid_of_file(out)
    about = {"cid": cid, "file": str(out), "size": made.size, "messages": made.count}
    topics = sorted({topic.name for topic in made.topics})
    length = f"{plural(made.count, 'message')}, {format_duration(made.duration_ns)}, {format_size(made.size)}"
    result = about | {"topics": topics, "durationNs": made.duration_ns}
    print_result(result, f"{cid}  {out}  {length}", as_json=as_json)


def key_expression(text: str) -> str:
    """Return the text if it is a key expression. Raises `InputError`."""
    try:
        return str(zenoh.KeyExpr(text))
    except zenoh.ZError as error:
        raise InputError(
            f"{text!r} is not a key expression: {said_by(error)}",
            hint="`*` matches one chunk, `**` any number of chunks",
            code="invalid-destination",
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

    `tell` is called with the seconds so far. Raises `RecordingFailed`, and `RemoteError`, which leaves no file.
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
        raise RemoteError(
            f"no message arrived on {', '.join(keys)}",
            hint="`aira/agent/ADDRESS/device/**` selects the devices of an agent",
            code="nothing-recorded",
        )
    return summary


async def _pass_time(seconds: float | None, tell: Callable[[float], None]) -> None:
    loop = asyncio.get_running_loop()
    begin = loop.time()
    while seconds is None or loop.time() - begin < seconds:
        left = BAR_INTERVAL if seconds is None else min(BAR_INTERVAL, seconds - (loop.time() - begin))
        await asyncio.sleep(max(0, left))
        tell(loop.time() - begin)
