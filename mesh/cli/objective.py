"""`aira objective`: adds, fetches, checks and converts objectives and recordings."""

from __future__ import annotations

import asyncio
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Literal

import click

from mesh.cli.files import (
    FETCH_SETTINGS,
    STORE_SETTINGS,
    fetch,
    file_or_cid,
    open_store,
    opened_store,
    require_new_file,
    require_readable,
    write_error,
)
from mesh.cli.lazy import LazyGroup
from mesh.cli.options import with_json, with_settings
from mesh.cli.output import format_duration, format_size, plural, print_json, printable, progress, run_sync
from mesh.recording import Limits, RecordingFormat, convert, preflight, recording_file, recording_files, recover
from mesh.running import report
from schemas import cid_of_file

if TYPE_CHECKING:
    from mesh.content import Store
    from mesh.recording.preflight import Preflight
    from mesh.settings import ContentSettings, Settings
    from mesh.work.objectives import ObjectiveUnfit


LIMIT_SETTINGS = {"size": "objective_size_limit", "expanded": "objective_expanded_limit"}
"""The settings for fields of `Limits`."""
CHECK_SETTINGS = (*STORE_SETTINGS, *LIMIT_SETTINGS.values())
_FORMATS: Final[dict[str, RecordingFormat]] = {".mcap": "mcap", ".bag": "bag"}
PIN = "user"
"""The pin of files that a user added; they are never evicted."""


command = LazyGroup(
    "objective",
    help="Create, show, check and fetch objectives and recordings: MCAP files (or ROS 1 bags) of a robot's messages.",
    lazy={
        "cat": ("mesh.cli.objective_show:cat", "print the messages"),
        "pack": ("mesh.cli.objective_pack:pack_objective", "create one from JSON lines, a bag, or live messages"),
        "show": ("mesh.cli.objective_show:show", "show the summary, topics, schemas and message times"),
    },
)


@command.command("add", short_help="add files to the store, from which robots fetch them")
@click.argument("files", nargs=-1, required=True, type=click.Path(path_type=Path))
@with_json
@with_settings(*CHECK_SETTINGS)
def add(settings: Settings, files: tuple[Path, ...], as_json: bool) -> None:
    """Add FILES to the store of the account in --keyfile, and print their CIDs. Without --keyfile they go to a store
    that commands read, but no agent serves.

    Others can fetch the files by CID while an agent of that account runs. Files that robots would refuse are added,
    too, but the exit code is 2.
    """
    refused = run_sync(lambda: _add(settings, files, as_json=as_json))
    for error in refused:
        report(error)
    if refused:
        raise SystemExit(2)


def _add(settings: Settings, files: tuple[Path, ...], *, as_json: bool) -> list[ObjectiveUnfit]:
    files = tuple(require_readable(recording_file(path)) for path in files)
    if not settings.keyfile:
        click.echo("no agent serves the store of no account; --keyfile FILE selects that of yours", err=True)
    added, refused = [], []
    with open_store(settings) as store:
        for path in files:
            with progress(f"adding {path.name}") as tell:
                cid = store.put_file(path, pin=PIN, progress=tell)
            with progress(f"examining {path.name}") as tell:
                outcome = preflight(path, limits_of(settings), progress=tell)
            if not outcome.ok:
                refused.append(_unfit(cid, outcome))
            added.append({"cid": cid, "file": str(path), "reason": outcome.reason})
            if not as_json:
                click.echo(cid if len(files) == 1 else f"{cid}  {path}")
    if as_json:
        print_json(added)
    return refused


def _unfit(cid: str, outcome: Preflight) -> ObjectiveUnfit:
    """The error for a file that robots would refuse; its hint names the setting of the limit that it exceeds."""
    from mesh.work.objectives import ObjectiveUnfit

    setting = LIMIT_SETTINGS.get(outcome.limit)
    hint = f"robots with a higher {setting} take it" if setting else ""
    return ObjectiveUnfit(cid, outcome.reason, printable(outcome.detail), hint=hint)


@command.command("get", short_help="fetch a file by its CID")
@click.argument("cid")
@click.option("--out", required=True, type=click.Path(path_type=Path), help="file to write")
@with_json
@with_settings(*FETCH_SETTINGS)
async def get(settings: Settings, cid: str, out: Path, as_json: bool) -> None:
    """Fetch the file with this CID from the store or the mesh, and verify every block."""
    require_new_file(out)
    async with opened_store(settings) as store:
        await fetch(settings, store, cid)
        try:
            with progress(f"writing {out.name}") as tell:
                size = (await asyncio.to_thread(store.copy, cid, out, progress=tell)).stat().st_size
        except OSError as error:
            raise write_error(out, error) from None
    if as_json:
        print_json({"cid": cid, "file": str(out), "size": size})
    else:
        click.echo(f"{out}  {format_size(size)}")


@command.command("check", short_help="check whether a robot would accept it, or check the whole store")
@click.argument("objective", required=False)
@click.option("--topics", help="topics that the robot accepts, separated by commas [any]")
@with_json
@with_settings(*CHECK_SETTINGS)
def check(settings: Settings, objective: str | None, topics: str | None, as_json: bool) -> None:
    """Check OBJECTIVE, a file or a CID in the store, as a robot does before it accepts a job: the format, the size and
    expanded size, all checksums, the schemas and the topics.

    Without OBJECTIVE, check every file of the store against its CID. The exit code is 1 if a check fails. The printed
    reason is a stable code.
    """

    def work() -> bool:
        with open_store(settings) as store:
            if objective is None:
                return _check_store(store, as_json=as_json)
            return _check(settings, store, objective, topics=topics, as_json=as_json)

    if not run_sync(work):
        raise SystemExit(1)


def _check(settings: Settings, store: Store, objective: str, *, topics: str | None, as_json: bool) -> bool:
    path, cid = _find_file(store, objective)
    taken = None if topics is None else frozenset(name.strip() for name in topics.split(",") if name.strip())
    with progress(f"reading {path.name}") as tell:
        outcome = preflight(path, limits_of(settings), topics=taken, progress=tell)
    if as_json:
        print_json(
            {"cid": cid, "file": str(path), "ok": outcome.ok, "reason": outcome.reason, "detail": outcome.detail}
        )
    elif outcome.ok and outcome.objective is not None:
        length = format_duration(outcome.objective.duration_ns)
        click.echo(f"{cid}  valid: {plural(outcome.objective.count, 'message')}, {length}")
    else:
        click.echo(f"{cid}  {outcome.reason}: {printable(outcome.detail)}")
    return outcome.ok


def limits_of(settings: ContentSettings) -> Limits:
    """How large an objective a robot with these settings accepts."""
    return Limits(size=settings.objective_size_limit, expanded=settings.objective_expanded_limit)


def _find_file(store: Store, objective: str) -> tuple[Path, str]:
    """The file and its CID. A file in the store is verified against its CID."""
    named = file_or_cid(objective)
    if isinstance(named, str):
        with progress(f"hashing {named[:8]}…") as tell:
            return store.verify(named, progress=tell), named
    path = require_readable(recording_file(named))
    return path, cid_of_file(path)


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
@click.argument("source", type=click.Path(path_type=Path))
@click.argument("out", type=click.Path(path_type=Path), required=False)
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
    options = {"to": to, "topics": topics, "leave_out": leave_out, "distribution": distribution}
    run_sync(lambda: _convert(source, out, options, as_json=as_json))


def _convert(source: Path, out: Path, options: dict[str, Any], *, as_json: bool) -> None:
    files = [require_readable(path) for path in recording_files(source)]
    require_new_file(out)
    cid = ",".join(map(cid_of_file, files))
    try:
        with progress(f"converting {source.name}") as tell:
            done = convert(source, out, cid=cid, progress=tell, **options)
    except OSError as error:
        raise write_error(out, error) from None
    made = cid_of_file(done.path)
    if as_json:
        written = {"messages": done.messages, "durationNs": done.duration_ns, "leftOut": done.left_out}
        print_json({"cid": made, "file": str(done.path), "source": cid, **written})
        return
    click.echo(f"{made}  {done.path}  {plural(done.messages, 'message')}, {format_duration(done.duration_ns)}")
    for topic, why in done.left_out.items():
        click.echo(f"left out: {printable(topic)}: {printable(why)}", err=True)


@command.command("recover", short_help="save the readable part of a damaged file")
@click.argument("file", type=click.Path(path_type=Path))
@click.option("--out", type=click.Path(path_type=Path), help="file to write [NAME.recovered.mcap]")
@with_json
def recover_file(file: Path, out: Path | None, as_json: bool) -> None:
    """Write the readable part of FILE, a truncated or damaged MCAP file, to a new file that records what is missing."""
    run_sync(lambda: _recover(file, out, as_json=as_json))


def _recover(file: Path, out: Path | None, *, as_json: bool) -> None:
    require_readable(file)
    if out is not None:
        require_new_file(out)
    try:
        recovered = recover(file, out)
    except OSError as error:
        raise write_error(out or file.parent, error) from None
    cid = cid_of_file(recovered.path)
    if as_json:
        print_json(
            {"cid": cid, "file": str(recovered.path), "messages": recovered.messages, "why": recovered.why},
        )
        return
    click.echo(f"{cid}  {recovered.path}  {plural(recovered.messages, 'message')}")
    click.echo(f"missing: {printable(recovered.why) or 'nothing'}")
