"""`aira objective show` and `aira objective cat`: the content of an objective or a recording, and its messages."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import click

from mesh.cli.files import FETCH_SETTINGS, fetch, file_or_cid, opened_store, require_readable
from mesh.cli.objective_messages import print_messages
from mesh.cli.objective_plot import draw
from mesh.cli.options import with_json, with_settings
from mesh.cli.output import (
    format_duration,
    format_size,
    plural,
    print_facts,
    print_json,
    print_table,
    printable,
    progress,
    run_sync,
)
from mesh.recording import GENEROUS, Objective, TopicRates, open_objective, rates_of, recording_file
from mesh.running import run_to_end
from schemas import cid_of_file

if TYPE_CHECKING:
    from collections.abc import Sequence

    from mesh.settings import Settings
    from schemas.payloads import PayloadType


SPANS: Final = 48
"""Columns of the plot in the terminal."""


PNG_SPANS: Final = 200


BARS: Final = " ▁▂▃▄▅▆▇█"


@click.command("show")
@click.argument("objective")
@click.option("--schemas", is_flag=True, help="also print the schema of each type")
@click.option("--png", type=click.Path(path_type=Path), help="also plot the numbers in the messages to this PNG file")
@click.option("--messages", is_flag=True, help="print the messages instead, as `aira objective cat` does")
@click.option("--topic", "topics", multiple=True, help="print only messages on this topic; may be repeated")
@with_json
@with_settings(*FETCH_SETTINGS)
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
        run_sync(lambda: print_messages(path, frozenset(topics), as_json=as_json))
    else:
        run_sync(lambda: _show(path, schemas=schemas, png=png, as_json=as_json))


@click.command("cat")
@click.argument("objective")
@click.option("--topic", "topics", multiple=True, help="only messages on this topic; may be repeated [all topics]")
@with_json
@with_settings(*FETCH_SETTINGS)
def cat(settings: Settings, objective: str, topics: tuple[str, ...], as_json: bool) -> None:
    """Print the messages of OBJECTIVE, a file or a CID: seconds since its first message, topic, value. --json prints
    an object for each; bytes are in `base64` there."""
    path = local_file(settings, objective)
    run_sync(lambda: print_messages(path, frozenset(topics), as_json=as_json))


def local_file(settings: Settings, objective: str) -> Path:
    """The file that a user named, or the one with that CID, fetched if needed. Exits if there is none."""
    path = run_sync(lambda: file_or_cid(objective))
    path = _fetched(settings, path) if isinstance(path, str) else path
    return run_sync(lambda: require_readable(recording_file(path)))


def _fetched(settings: Settings, cid: str) -> Path:
    found: list[Path] = []

    async def main() -> None:
        async with opened_store(settings) as store:
            found.append(await fetch(settings, store, cid))

    run_to_end(main)
    return found[0]


def _show(path: Path, *, schemas: bool, png: Path | None, as_json: bool) -> None:
    with progress(f"reading {path.name}") as tell:
        objective = open_objective(path, GENEROUS, progress=tell)
    if png is not None:
        draw(objective, _rates(objective, PNG_SPANS), png)
    if as_json:
        print_json(_objective_json(objective))
        return
    _print_summary(objective)
    _print_topics(objective)
    if schemas:
        _print_schemas(objective)


def _rates(objective: Objective, spans: int) -> TopicRates:
    start, duration = objective.start_ns, objective.duration_ns
    return rates_of(objective.messages(), start_ns=start, duration_ns=duration, spans=spans)


def _objective_json(objective: Objective) -> dict[str, Any]:
    rates = _rates(objective, SPANS)
    return {
        "cid": cid_of_file(objective.path),
        "file": str(objective.path),
        "format": objective.format,
        "size": objective.size,
        "messages": objective.count,
        "startNs": objective.start_ns,
        "durationNs": objective.duration_ns,
        "topics": [
            {"topic": name, "messages": sum(rates.counts.get(name, ())), "types": [_described(kind) for kind in kinds]}
            for name, kinds in _kinds(objective).items()
        ],
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


def _described(kind: PayloadType) -> dict[str, str]:
    schema = kind.schema_data.decode(errors="replace")
    return {"type": kind.zenoh_encoding, "schemaEncoding": kind.schema_encoding, "schema": schema}


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
