"""`aira cid`: the CIDv0 of files."""

from __future__ import annotations

import sys
from pathlib import Path

import click

from mesh.cli.options import with_json
from mesh.cli.output import print_json
from mesh.errors import InputError
from schemas import cid_of_file, cid_of_stream


@click.command("cid")
@click.argument("files", nargs=-1, required=True, type=click.Path(path_type=Path, allow_dash=True))
@with_json
def command(files: tuple[Path, ...], as_json: bool) -> None:
    """Print the CIDv0 of FILES, their name on IPFS and in the mesh; `-` reads standard input.

    For one file, only its CID is printed; for several, a line for each with the CID and the file. --json prints an
    object for each.
    """
    for path in files:
        try:
            cid = cid_of_stream(sys.stdin.buffer) if str(path) == "-" else cid_of_file(path)
        except OSError as error:
            raise InputError(f"can't read {path}: {error.strerror}", code="file-unreadable") from None
        if as_json:
            print_json({"cid": cid, "file": str(path)})
        else:
            click.echo(cid if len(files) == 1 else f"{cid}  {path}")
