"""`aira objective add`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from mesh.cli.files import at_once
from mesh.cli.holdings import STORE, open_store, readable
from mesh.cli.options import with_settings
from mesh.cli.printing import print_json, visible, with_json
from mesh.cli.progress import progress
from mesh.recording import preflight

if TYPE_CHECKING:
    from mesh.settings import Settings

PIN = "user"
"""The label under which files that a person added are kept until that person removes them."""


@click.command("add")
@click.argument("files", nargs=-1, required=True, type=click.Path(path_type=Path))
@with_json
@with_settings(*STORE)
def command(settings: Settings, files: tuple[Path, ...], as_json: bool) -> None:
    """Put FILES into the store and print their CIDs. Whoever asks the mesh for such a CID gets the file while an agent
    with this store runs: with --keyfile, that of the account.

    A file that robots would refuse is put there all the same, with a word of warning.
    """
    at_once(lambda: _add(settings, files, as_json=as_json))


def _add(settings: Settings, files: tuple[Path, ...], *, as_json: bool) -> None:
    for path in files:
        readable(path)
    added = []
    with open_store(settings) as store:
        for path in files:
            with progress(f"adding {path.name}") as tell:
                cid = store.put_file(path, pin=PIN, progress=tell)
            with progress(f"examining {path.name}") as tell:
                outcome = preflight(path, progress=tell)
            if not outcome.ok:
                click.echo(f"aira: robots would refuse it ({outcome.reason}): {visible(outcome.detail)}", err=True)
            added.append({"cid": cid, "file": str(path), "reason": outcome.reason})
            if not as_json:
                click.echo(cid if len(files) == 1 else f"{cid}  {path}")
    if as_json:
        print_json(added)
