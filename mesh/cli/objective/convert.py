"""`aira objective convert`."""

from __future__ import annotations

from pathlib import Path

import click

from mesh.cli.files import at_once, duration_words, free, unwritable
from mesh.cli.holdings import readable
from mesh.cli.printing import plural, print_json, with_json
from mesh.cli.progress import progress
from mesh.recording import GENEROUS, NotARecording, bag_to_mcap, open_objective
from schemas import cid_of_file


@click.command("convert")
@click.argument("bag", type=click.Path(path_type=Path))
@click.argument("out", type=click.Path(path_type=Path), required=False)
@with_json
def command(bag: Path, out: Path | None, as_json: bool) -> None:
    """Make the MCAP file OUT [BAG with the ending .mcap] of a ROS 1 bag: payloads, types, times, topics and what the
    connections say stay as they are, and the bag's CID is noted. Prints the new file's CID."""
    at_once(lambda: _convert(bag, out or bag.with_suffix(".mcap"), as_json=as_json))


def _convert(bag: Path, out: Path, *, as_json: bool) -> None:
    readable(bag)
    free(out)
    with progress(f"reading {bag.name}") as tell:
        if open_objective(bag, GENEROUS, progress=tell).format != "bag":
            raise NotARecording(bag, "it is no ROS 1 bag")
    source = cid_of_file(bag)
    try:
        with progress(f"converting {bag.name}") as tell:
            bag_to_mcap(bag, out, cid=source, limits=GENEROUS, progress=tell)
    except OSError as error:
        raise unwritable(out, error) from None
    made, cid = open_objective(out, GENEROUS), cid_of_file(out)
    if as_json:
        facts = {"cid": cid, "file": str(out), "source": source, "messages": made.count, "durationNs": made.duration_ns}
        print_json(facts)
    else:
        click.echo(f"{cid}  {out}  {plural(made.count, 'message')}, {duration_words(made.duration_ns)}")
