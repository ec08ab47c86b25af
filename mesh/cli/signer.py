"""`aira signer`, which has the key, and what its owner does with it: `aira mcp policy`, `approve`, `deny`, `log`."""

from __future__ import annotations

import asyncio
import logging
import sys
from contextlib import AsyncExitStack
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
import msgspec

from mesh.cli.options import with_json, with_settings
from mesh.cli.output import announce, plural, print_facts, print_json, print_line, print_table, printable
from mesh.role.running import open_when_ready, run_until_stopped, serve_on_each_chain, wait_for_files
from mesh.settings import AccountSettings, ChainSettings, NetworkSettings, TelemetrySettings

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable

    from mesh.settings import Settings
    from mesh.signer.client import SignerClient
    from mesh.signer.protocol import Consent

events = logging.getLogger(__name__)

FILE = click.Path(dir_okay=False, path_type=Path)


@click.command("signer")
@click.option("--policy", required=True, type=FILE, help="file (TOML) that says what programs may order")
@with_settings(
    NetworkSettings,
    "lighthouse_contract",
    "erc20_token",
    AccountSettings,
    "blocked_signers",
    "objective_size_limit",
    "content_limit",
    "fetch_timeout",
    "deadline_limit",
    ChainSettings,
    TelemetrySettings,
)
def command(settings: Settings, policy: Path) -> None:
    """Order for programs, with the key of --keyfile, what the owner's policy allows. Ctrl-C stops it.

    Programs, such as `aira mcp`, reach it by the socket signer/door.sock in the data folder, and get no key. Only
    processes of the same user can. What needs a person's yes is allowed with `aira mcp approve`.
    """
    settings.keyfile_and_password()
    run_until_stopped(partial(serve, settings, policy), settings=settings, role="signer")


async def serve(settings: Settings, policy: Path) -> None:
    """Serve until cancelled, also when a development chain is started afresh."""
    await serve_on_each_chain(settings, partial(_serve, policy))


async def _serve(policy: Path, settings: Settings) -> None:
    from mesh.signer.service import Signer

    await wait_for_files(settings)
    async with AsyncExitStack() as stack:
        signer = await open_when_ready(stack, settings, partial(Signer, settings, policy), role="signer")
        words = f"signer      orders for {signer.agent.address}, policy {signer.policy.hash[:12]}"
        announce(events, "signer-started", words, account=signer.agent.address, policy=signer.policy.hash)
        await asyncio.Event().wait()


@click.group("policy")
def policy() -> None:
    """Check and explain a policy: what programs may order. Put a changed one into use."""


@policy.command("check")
@click.argument("file", type=FILE)
def check(file: Path) -> None:
    """Say which mistakes FILE has, each with its line. The exit code is 0 if there are none, else 2."""
    from mesh.signer.policy import InvalidPolicy, parse_policy, read_policy_file

    data = read_policy_file(file)
    try:
        parse_policy(data, name=str(file))
    except InvalidPolicy as error:
        for fault in error.faults:
            print_line(printable(fault))
        sys.exit(2)
    print_line(f"{file}: no mistakes")


@policy.command("explain")
@click.argument("file", type=FILE)
def explain(file: Path) -> None:
    """Say in plain words what FILE allows."""
    from mesh.signer.policy import parse_policy, read_policy_file

    for line in parse_policy(read_policy_file(file), name=str(file)).words():
        print_line(printable(line))


def _asks_owner(function: Callable[..., Awaitable[None]]) -> Callable[..., Any]:
    """A command that talks to the signer on the owner's socket, as its first argument."""

    async def asked(settings: Settings, **options: Any) -> None:
        from mesh.signer.client import SignerClient
        from mesh.signer.protocol import OWNER_SOCKET

        async with SignerClient(settings.state_directory / "signer" / OWNER_SOCKET) as signer:
            await function(signer, **options)

    asked.__doc__ = function.__doc__
    return with_settings("data_dir")(asked)


@policy.command("use")
@_asks_owner
async def use(signer: SignerClient) -> None:
    """Let the signer read its policy's file again, and use it from now on. Consents that wait are void.

    It also takes the clock of this machine as right, if an earlier, wrong one was ahead.
    """
    used = await signer.use_policy()
    for line in used.words:
        print_line(printable(line))


@click.command("approve")
@click.argument("consent", required=False, metavar="[ID]")
@with_json
@_asks_owner
async def approve(signer: SignerClient, consent: str | None, as_json: bool) -> None:
    """Allow the order that waits with this ID, once. Without an ID, list the orders that wait for a yes."""
    if consent is None:
        await _list(signer, as_json=as_json)
        return
    job = await signer.approve(consent)
    if as_json:
        print_json({"job": msgspec.to_builtins(job)})
    else:
        print_line(f"allowed: {job.job_id}, at most {job.cost.text}")


@click.command("deny")
@click.argument("consent", required=False, metavar="[ID]")
@with_json
@_asks_owner
async def deny(signer: SignerClient, consent: str | None, as_json: bool) -> None:
    """Don't allow the order that waits with this ID. Without an ID, list the orders that wait for a yes."""
    if consent is None:
        await _list(signer, as_json=as_json)
        return
    job = await signer.deny(consent)
    if as_json:
        print_json({"job": msgspec.to_builtins(job)})
    else:
        print_line(f"not allowed: {job.job_id}")


async def _list(signer: SignerClient, *, as_json: bool) -> None:
    consents = await signer.consents()
    if as_json:
        print_json({"consents": [msgspec.to_builtins(one) for one in consents]})
    elif not consents:
        print_line("no order waits for a yes")
    for number, one in enumerate(() if as_json else consents):
        if number:
            print_line("")
        _show(one)


def _show(one: Consent) -> None:
    robot = f"{printable(one.name.text)} ({one.robot})" if one.name else one.robot
    print_facts(
        {
            "consent": one.id,
            "cost": f"at most {one.cost.text}",
            "model": f"{printable(one.title.text)} ({one.model})" if one.title else one.model,
            "robot": robot,
            "why": one.why,
            "note": printable(one.note.text) or None,
            "expires": one.expires,
        }
    )
    for line in one.messages:
        print_line(f"  {printable(line.text)}")
    if one.more:
        print_line(f"  and {plural(one.more, 'message')} more")


@click.command("log")
@click.option("--verify", "is_verified", is_flag=True, help="check that no entry was changed, removed or added")
@click.option("--lines", type=click.IntRange(1, 1000), default=50, show_default=True, help="the latest entries")
@with_json
@_asks_owner
async def log(signer: SignerClient, is_verified: bool, lines: int, as_json: bool) -> None:
    """Show what programs asked for, what was allowed and refused, and what came of it.

    With --verify the exit code is 0 if the log is complete and unchanged, else 1.
    """
    if is_verified:
        found = await signer.verify_log()
        if as_json:
            print_json(msgspec.to_builtins(found))
        elif found.holds:
            print_line(f"{found.entries:,} entries, signed by {found.signer}, last hash {found.head}")
        else:
            print_line(f"the log was changed: {found.fault}")
        sys.exit(0 if found.holds else 1)
    entries = (await signer.log(limit=lines)).entries
    if as_json:
        print_json({"entries": [msgspec.to_builtins(one) for one in entries]})
        return
    rows = [
        (
            one.time,
            one.event,
            printable(" ".join(f"{name}={value}" for name, value in one.facts.items() if value != "")),
        )
        for one in entries
    ]
    print_table(("time", "event", "facts"), rows)
