"""`aira objective recover`."""

from __future__ import annotations

from pathlib import Path

import click

from mesh.cli.files import at_once, free, unwritable
from mesh.cli.holdings import readable
from mesh.cli.printing import plural, print_json, visible, with_json
from mesh.recording import recover
from schemas import cid_of_file


@click.command("recover")
@click.argument("file", type=click.Path(path_type=Path))
@click.option("--out", type=click.Path(path_type=Path), help="file to write [NAME.recovered.mcap]")
@with_json
def command(file: Path, out: Path | None, as_json: bool) -> None:
    """Write what is readable of FILE, an MCAP file that was cut or has rotted, to a new, whole one, which says so."""
    at_once(lambda: _recover(file, out, as_json=as_json))


def _recover(file: Path, out: Path | None, *, as_json: bool) -> None:
    readable(file)
    if out is not None:
        free(out)
    try:
        recovered = recover(file, out)
    except OSError as error:
        raise unwritable(out or file.parent, error) from None
    cid = cid_of_file(recovered.path)
    if as_json:
        print_json(
            {"cid": cid, "file": str(recovered.path), "messages": recovered.messages, "why": recovered.why},
        )
        return
    click.echo(f"{cid}  {recovered.path}  {plural(recovered.messages, 'message')}")
    click.echo(f"what is missing: {visible(recovered.why) or 'nothing'}")
