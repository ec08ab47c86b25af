"""`aira objective check`."""

from __future__ import annotations

from typing import TYPE_CHECKING

import click

from mesh.cli.files import at_once, duration_words, size_words
from mesh.cli.holdings import STORE, file_or_cid, open_store, readable
from mesh.cli.options import with_settings
from mesh.cli.printing import plural, print_json, visible, with_json
from mesh.cli.progress import progress
from mesh.recording import Limits, preflight
from schemas import cid_of_file

if TYPE_CHECKING:
    from pathlib import Path

    from mesh.content import Store
    from mesh.settings import Settings

SETTINGS = (*STORE, "objective_size_limit", "objective_expanded_limit")


@click.command("check")
@click.argument("objective", required=False)
@click.option("--topics", help="topics that the robot takes, separated by commas [any]")
@with_json
@with_settings(*SETTINGS)
def command(settings: Settings, objective: str | None, topics: str | None, as_json: bool) -> None:
    """Look at OBJECTIVE, a file or a CID in the store, as a robot does before it takes a job: what it is, its size and
    what it expands to, every checksum, its schemas, its topics.

    Without an OBJECTIVE the whole store is checked: every file against its CID. Exit code 1: something is wrong, and
    the reason is a word for programs.
    """

    def work() -> bool:
        with open_store(settings) as store:
            if objective is None:
                return _check_store(store, as_json=as_json)
            return _check(settings, store, objective, topics=topics, as_json=as_json)

    if not at_once(work):
        raise SystemExit(1)


def _check(settings: Settings, store: Store, objective: str, *, topics: str | None, as_json: bool) -> bool:
    path, cid = _found(store, objective)
    limits = Limits(size=settings.objective_size_limit, expanded=settings.objective_expanded_limit)
    taken = None if topics is None else frozenset(name.strip() for name in topics.split(",") if name.strip())
    with progress(f"reading {path.name}") as tell:
        outcome = preflight(path, limits, topics=taken, progress=tell)
    if as_json:
        print_json(
            {"cid": cid, "file": str(path), "ok": outcome.ok, "reason": outcome.reason, "detail": outcome.detail}
        )
    elif outcome.ok and outcome.objective is not None:
        length = duration_words(outcome.objective.duration_ns)
        click.echo(f"{cid}  fit to be played: {plural(outcome.objective.count, 'message')}, {length}")
    else:
        click.echo(f"{cid}  {outcome.reason}: {visible(outcome.detail)}")
    return outcome.ok


def _found(store: Store, objective: str) -> tuple[Path, str]:
    """The file that is meant, and its CID. One of the store is compared with its CID."""
    named = file_or_cid(objective)
    if isinstance(named, str):
        with progress(f"hashing {named[:8]}…") as tell:
            return store.verify(named, progress=tell), named
    return readable(named), cid_of_file(named)


def _check_store(store: Store, *, as_json: bool) -> bool:
    with progress("checking the store") as tell:
        check = store.check(progress=tell)
    if as_json:
        print_json({"files": check.files, "bytes": check.bytes, "damaged": list(check.damaged)})
    else:
        click.echo(f"{plural(check.files, 'file')}, {size_words(check.bytes)}, {len(check.damaged)} damaged")
        for cid in check.damaged:
            click.echo(f"{cid}  damaged, and set aside; fetch it again")
    return not check.damaged
