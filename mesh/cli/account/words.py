"""What the commands of accounts share."""

from __future__ import annotations

from pathlib import Path

import click

from mesh.cli.printing import print_json, say

FILE = click.Path(dir_okay=False, path_type=Path)
"""An option or argument that names a file."""


def print_account(address: str, keyfile: Path, as_json: bool) -> None:
    """Print an account's address; for programs also where its key is."""
    if as_json:
        print_json({"address": address, "keyfile": str(keyfile)})
    else:
        say(address)
