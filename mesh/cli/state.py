"""`aira state`: shows, backs up and restores the state of agents."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

import click

from mesh.cli.options import FILE, with_json, with_settings
from mesh.cli.output import format_size, plural, print_facts, print_json, print_table, printable

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

    from mesh.settings import Settings
    from mesh.state import ArchiveContents, Inventory


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
    from mesh.state import examine_archive, take_inventory

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
async def backup(settings: Settings, file: Path, content: str, as_json: bool) -> None:
    """Write the state of the agents of the data folder to FILE (tar.zst). An existing FILE is replaced at the end.

    The agents may be running: the backup contains what a crash at one moment would leave.
    """
    from dataclasses import asdict

    from mesh.state import ContentScope, back_up

    done = await back_up(settings.state_directory, file, content=ContentScope(content))
    if as_json:
        print_json({"file": str(file), **asdict(done)})
        return
    print_facts(
        {
            "backup": file,
            "size": format_size(done.size),
            "accounts": ", ".join(done.accounts) or None,
            "open jobs": done.jobs,
            "content": plural(done.files, "file"),
            "missing": ", ".join(done.missing) or None,
        }
    )


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
    from mesh.state import ExistingState
    from mesh.state import restore as restore_backup

    folder = settings.state_directory
    done = await restore_backup(file, folder, existing=ExistingState(existing))
    jobs = {job.liability.address: job.phase.value for job in done.jobs}
    if as_json:
        aside = None if done.aside is None else str(done.aside)
        print_json({"folder": str(folder), "made": done.made, "parts": done.parts, "jobs": jobs, "aside": aside})
        return
    print_facts(
        {
            "restored to": folder,
            "backup of": printable(done.made),
            "old state": done.aside,
            "open jobs": len(jobs),
        }
    )
    print_facts(jobs)


def _print_inventory(found: Inventory) -> None:
    rows = []
    for account in found.accounts:
        rows += [
            (
                account.address,
                chain.chain,
                "-" if chain.block is None else chain.block,
                _counted(chain.jobs),
                _counted(chain.verdicts),
                chain.waiting,
                chain.recordings,
                ", ".join(chain.provides) or "-",
            )
            for chain in account.chains
        ]
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
