"""`aira cid`: the CIDv0 of files."""

from __future__ import annotations

import sys
from pathlib import Path

import click

from mesh.errors import InputError
from mesh.running import fail
from schemas import cid_of_file, cid_of_stream


@click.command("cid")
@click.argument("files", nargs=-1, required=True, type=click.Path(path_type=Path, allow_dash=True))
def command(files: tuple[Path, ...]) -> None:
    """Print the CIDv0 of FILES, the name that IPFS and the mesh know them by; `-` reads the standard input.

    One file: its CID alone. Several: a line each, the CID and the file.
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
        fail(InputError(f"can't read {path}: {error.strerror}"))
