"""`aira objective get`."""

from __future__ import annotations

import asyncio
from pathlib import Path
from typing import TYPE_CHECKING

import click

from mesh.cli.files import free, size_words, unwritable
from mesh.cli.holdings import MESH, fetch, opened_store
from mesh.cli.options import with_settings
from mesh.cli.printing import print_json, with_json
from mesh.cli.progress import progress
from mesh.running import run_to_end

if TYPE_CHECKING:
    from mesh.settings import Settings


@click.command("get")
@click.argument("cid")
@click.option("--out", required=True, type=click.Path(path_type=Path), help="file to write it to")
@with_json
@with_settings(*MESH)
def command(settings: Settings, cid: str, out: Path, as_json: bool) -> None:
    """Fetch the file of CID, from the store or from whoever in the mesh holds it, every block checked."""
    run_to_end(lambda: _get(settings, cid, out, as_json=as_json))


async def _get(settings: Settings, cid: str, out: Path, *, as_json: bool) -> None:
    free(out)
    async with opened_store(settings) as store:
        await fetch(settings, store, cid)
        try:
            with progress(f"writing {out.name}") as tell:
                size = (await asyncio.to_thread(store.copy, cid, out, progress=tell)).stat().st_size
        except OSError as error:
            raise unwritable(out, error) from None
    if as_json:
        print_json({"cid": cid, "file": str(out), "size": size})
    else:
        click.echo(f"{out}  {size_words(size)}")
