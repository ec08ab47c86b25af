"""`aira cid`: the CIDv0 of files."""

from __future__ import annotations

import sys
from pathlib import Path

import click

from mesh.cli.errors import FileUnreadable
from mesh.running import fail
from schemas import cid_of_file, cid_of_stream


@click.command("cid")
@click.argument("files", nargs=-1, required=True, type=click.Path(path_type=Path, allow_dash=True))
def command(files: tuple[Path, ...]) -> None:
    """Print the CIDv0 of FILES, their name on IPFS and in the mesh; `-` reads standard input.

    For one file, only its CID is printed; for several, a line for each with the CID and the file.
    """
    for path in files:
        cid = _cid(path)
        click.echo(cid if len(files) == 1 else f"{cid}  {path}")


def _cid(path: Path) -> str:
    try:
        if str(path) == "-":
            return cid_of_stream(sys.stdin.buffer)
        return cid_of_file(path)
    except OSError as error:
        fail(FileUnreadable(f"can't read {path}: {error.strerror}"))
