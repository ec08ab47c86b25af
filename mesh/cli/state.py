"""`aira state`: shows, backs up and restores the state of agents."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

import click

from mesh.cli.options import FILE, with_json, with_settings
from mesh.cli.output import format_size, plural, print_facts, print_json, print_result, print_table, printable

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

    from mesh.ops.state import ArchiveContents, ContentScope, Inventory
    from mesh.settings import Settings


@click.group("state")
def command() -> None:
    """Show, back up and restore the state of the agents and providers of a data folder: jobs, signed messages,
    unfinished recordings, content, and withdrawals. Keyfiles and passwords are never included.
    """


@command.command("show", short_help="show the state, or the content of a backup")
@click.argument("file", required=False, type=FILE)
@with_json
@with_settings("data_dir")
async def show(settings: Settings, file: Path | None, as_json: bool) -> None:
    """Show the state of the agents of the data folder; they may be running. With FILE, verify the checksums of that
    backup and show its content.
    """
    from mesh.ops.state import examine_archive, take_inventory

    if file is None:
        inventory = await take_inventory(settings.state_directory)
        print_json(inventory) if as_json else _print_inventory(inventory)
    else:
        contents = await asyncio.to_thread(examine_archive, file)
        print_json(contents) if as_json else _print_archive(contents)


@command.command("backup", short_help="write the state to a file, even while agents run")
@click.argument("file", type=FILE)
@click.option(
    "--content",
    type=click.Choice(["needed", "all", "none"]),
    default="needed",
    show_default=True,
    help="content files to include: pinned ones and those that jobs need, all, or none",
)
@with_json
@with_settings("data_dir")
async def backup(settings: Settings, file: Path, content: ContentScope, as_json: bool) -> None:
    """Write the state of the agents of the data folder to FILE (tar.zst). An existing FILE is replaced at the end.

    The agents may be running: the backup contains what a crash at one moment would leave.
    """
    from dataclasses import asdict

    from mesh.ops.state import back_up

    done = await back_up(settings.state_directory, file, content=content)
    facts = {
        "backup": file,
        "size": format_size(done.size),
        "accounts": ", ".join(done.accounts) or None,
        "open jobs": done.jobs,
        "content": plural(done.files, "file"),
        "missing": ", ".join(done.missing) or None,
    }
    print_result({"file": str(file), **asdict(done)}, facts, as_json=as_json)


@command.command("restore", short_help="restore a backup")
@click.argument("file", type=FILE)
@click.option(
    "--existing",
    type=click.Choice(["refuse", "set-aside"]),
    default="refuse",
    show_default=True,
    help="if a state exists: refuse, or move it to the folder .replaced-TIME",
)
@with_json
@with_settings("data_dir")
async def restore(settings: Settings, file: Path, existing: str, as_json: bool) -> None:
    """Restore the backup FILE to the data folder, whose agents must be stopped.

    Changes nothing unless FILE is valid as a whole. Make sure that the agent that was backed up never runs again: two
    agents with one account would do every job twice.
    """
    from mesh.ops.state import restore as restore_backup

    folder = settings.state_directory
    done = await restore_backup(file, folder, set_aside=existing == "set-aside")
    jobs = {job.liability.address: job.phase.value for job in done.jobs}
    result = {"folder": str(folder), "made": done.made, "parts": done.parts, "jobs": jobs}
    facts = {"restored to": folder, "backup of": printable(done.made), "old state": done.aside, "open jobs": len(jobs)}
    print_result(result | {"aside": done.aside and str(done.aside)}, facts, as_json=as_json)
    if not as_json:
        print_facts(jobs)


def _print_inventory(found: Inventory) -> None:
    rows = []
    for account in found.accounts:
        for one in account.chains:
            counts = _counted(one.jobs), _counted(one.verdicts), one.waiting, one.recordings
            block = "-" if one.block is None else one.block
            rows.append((account.address, one.chain, block, *counts, ", ".join(one.provides) or "-"))
    if rows:
        print_table(("ACCOUNT", "CHAIN", "BLOCK", "JOBS", "VERDICTS", "TO SEND", "RECORDING", "PROVIDER OF"), rows)
    print_facts(
        {
            account.address: f"{plural(account.files, 'file')}, {format_size(account.bytes)}"
            f" ({format_size(account.pinned_bytes)} pinned){', in use' if account.in_use else ''}"
            for account in found.accounts
        }
    )
    print_facts({"pending transactions": found.transactions})


def _counted(counts: Mapping[str, int]) -> str:
    return ", ".join(f"{count} {name}" for name, count in counts.items()) or "none"


def _print_archive(found: ArchiveContents) -> None:
    print_facts(
        {
            "created": printable(found.made),
            "by": printable(found.software),
            "parts": ", ".join(found.parts),
            "files": ", ".join(f"{count} {kind}" for kind, count in found.files.items()),
            "content": printable(found.content),
            "unpacked": format_size(found.bytes),
            "checksums": "valid",
        }
    )
