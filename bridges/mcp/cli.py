"""`aira mcp`: the door for programs that speak the Model Context Protocol."""

from __future__ import annotations

import asyncio
import logging
import re
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import click
import msgspec

from bridges.serving import door_fields, door_socket, served_door, with_door
from mesh.base.extras import needs_extra
from mesh.cli.options import FILE, with_json, with_settings
from mesh.cli.output import announce, json_text, plural, print_facts, print_json, print_line, print_result, printable
from mesh.errors import AiraError, InputError
from mesh.role.running import run_until_stopped
from mesh.settings import StorageSettings
from mesh.signer.policy import InvalidPolicy, parse_policy, read_policy_file
from mesh.signer.protocol import CONSENT_ID, OWNER_SOCKET, signer_folder

if TYPE_CHECKING:
    from mesh.settings import Settings
    from mesh.signer.client import SignerClient
    from mesh.signer.protocol import Consent

log = logging.getLogger(__name__)


@click.group("mcp", invoke_without_command=True, short_help="let assistants hire robots, within your policy (MCP)")
@click.option("--http", metavar="HOST:PORT", help="serve streamable HTTP there instead of stdin and stdout")
@with_door("mcp")
@click.option("--issuer", default="", metavar="URL", help="OAuth server whose tokens for --url are taken instead")
@with_settings(StorageSettings, "log_level", "log_format")
@click.pass_context
def command(context: click.Context, /, settings: Settings, **options: Any) -> None:
    """Serve a door to the market for assistants with a language model, and other clients of MCP.

    The door has no key: orders are signed by `aira signer`, within its policy. By default it speaks on stdin and
    stdout, for a client that starts this command itself; with --http on an address, to holders of the token.
    """
    if context.invoked_subcommand is None:
        run_until_stopped(lambda: _serve(settings, options), settings=settings, role="mcp")


async def _serve(settings: Settings, options: dict[str, Any]) -> None:
    with needs_extra("mcp", "aira mcp"):
        from bridges.mcp._door import McpDoor, serve_stdio
        from mesh.signer.client import SignerClient

    async with SignerClient(door_socket(settings, options)) as signer:
        server = McpDoor(signer).server
        if options["http"] is None:
            if sys.stdin.isatty():
                click.echo("aira mcp speaks MCP on stdin and stdout; --http serves an address instead", err=True)
            await serve_stdio(server)
            return
        from bridges.mcp._http import PATH, McpOptions, application

        issuer = options["issuer"]
        fields = await asyncio.to_thread(door_fields, "mcp", settings, options, has_token=not issuer)
        chosen = McpOptions(**fields, issuer=issuer)
        async with served_door(application(server, chosen), chosen) as url:
            announce(log, "mcp-started", f"mcp         {url}{PATH}", url=f"{url}{PATH}")
            await asyncio.Event().wait()


OWNER: Final = click.option(
    "--socket", type=click.Path(path_type=Path), help="owner.sock of the signer [in its folder]"
)
"""The option of commands for the person alone."""


@command.command("approve", short_help="list the orders that wait for your yes, or allow one")
@click.argument("consent", required=False, metavar="[ID]")
@OWNER
@with_json
@with_settings("data_dir")
async def approve(settings: Settings, socket: Path | None, consent: str | None, as_json: bool) -> None:
    """Allow the order with ID, once. Without ID, list the orders that wait for a person's yes."""
    async with _owner(settings, socket) as signer:
        if consent is None:
            _print_consents(await signer.consents(), as_json=as_json)
        else:
            job = await signer.approve(_consent_id(consent))
            print_result(msgspec.to_builtins(job), f"allowed: {job.job_id} is {job.state}", as_json=as_json)


@command.command("deny", short_help="refuse an order that waits for your yes")
@click.argument("consent", metavar="ID")
@OWNER
@with_json
@with_settings("data_dir")
async def deny(settings: Settings, socket: Path | None, consent: str, as_json: bool) -> None:
    """Refuse the order with ID. Nothing was signed for it, and nothing will be."""
    async with _owner(settings, socket) as signer:
        job = await signer.deny(_consent_id(consent))
    print_result(msgspec.to_builtins(job), f"denied: {job.job_id}", as_json=as_json)


@command.command("log", short_help="what programs asked for, and what came of it")
@click.option("--verify", is_flag=True, help="check that the log is complete and unchanged")
@click.option("--limit", type=click.IntRange(1, 1000), default=100, show_default=True, help="latest entries to show")
@OWNER
@with_json
@with_settings("data_dir")
async def show_log(settings: Settings, socket: Path | None, verify: bool, limit: int, as_json: bool) -> None:
    """Print the signer's log: everything that was asked, allowed, refused and approved.

    With --verify, check it instead, and exit with 1 if an entry was changed, removed or added.
    """
    async with _owner(settings, socket) as signer:
        if verify:
            checked = await signer.verify_log()
            count = "1 entry" if checked.entries == 1 else f"{checked.entries:,} entries"
            words = f"{count}, all signed by {checked.signer} and in order"
            if not checked.holds:
                raise AiraError(f"the log does not hold: {checked.fault}", code="log-broken")
            print_result(msgspec.to_builtins(checked), words, as_json=as_json)
            return
        found = await signer.log(limit=limit)
    if as_json:
        print_json(found)
    for entry in () if as_json else found.entries:
        facts = " ".join(f"{name}={json_text(value)}" for name, value in entry.facts.items())
        print_line(printable(f"{entry.number:>6}  {entry.time}  {entry.event}  {facts}"))


@command.group("policy", short_help="check, explain and use a policy")
def policy() -> None:
    """The policy: what programs may order for you."""


@policy.command("check", short_help="find the mistakes in a policy")
@click.argument("file", type=FILE)
@with_json
def check(file: Path, as_json: bool) -> None:
    """Check FILE, and that only you can change it. Lists all mistakes, each with its line."""
    try:
        found = parse_policy(read_policy_file(file), name=file.name)
    except InvalidPolicy as error:
        for fault in error.faults[1:]:
            click.echo(printable(fault), err=True)
        error.hint = ""  # it names this command
        raise
    result = {"file": str(file), "hash": found.hash, "rules": len(found.rules)}
    print_result(result, f"{file} holds {plural(len(found.rules), 'rule')}, no mistakes", as_json=as_json)


@policy.command("explain", short_help="say in plain words what a policy allows")
@click.argument("file", type=FILE)
@with_json
def explain(file: Path, as_json: bool) -> None:
    """Say in plain words what the policy in FILE allows."""
    found = parse_policy(read_policy_file(file), name=file.name)
    _print_words(found.hash, found.words(), as_json=as_json)


@policy.command("use", short_help="let the signer read its policy again")
@OWNER
@with_json
@with_settings("data_dir")
async def use(settings: Settings, socket: Path | None, as_json: bool) -> None:
    """Let the signer read its policy's file again, and follow it from now on. Orders that wait for a yes are void."""
    async with _owner(settings, socket) as signer:
        found = await signer.use_policy()
    _print_words(found.hash, found.words, as_json=as_json)


def _owner(settings: Settings, socket: Path | None) -> SignerClient:
    with needs_extra("mcp", "aira mcp"):
        from mesh.signer.client import SignerClient

    return SignerClient(socket or signer_folder(settings) / OWNER_SOCKET)


def _consent_id(given: str) -> str:
    """The id of a consent. Raises `InputError`."""
    if not re.fullmatch(CONSENT_ID, given):
        raise InputError(
            f"{given[:80]!a} is not the id of an order that waits",
            hint="`aira mcp approve` lists them",
            code="invalid-request",
        )
    return given


def _print_words(digest: str, words: tuple[str, ...], *, as_json: bool) -> None:
    if as_json:
        print_json({"hash": digest, "words": words})
        return
    for line in words:
        print_line(printable(line))


def _print_consents(consents: tuple[Consent, ...], *, as_json: bool) -> None:
    if as_json:
        print_json({"consents": consents})
        return
    if not consents:
        print_line("no orders wait for your yes")
    for one in consents:
        title = f" ({printable(one.title.text)})" if one.title else ""
        facts: dict[str, object] = {
            one.id: f"{one.cost.text} at most, until {one.expires}",
            "  robot": one.robot,
            "  model": f"{one.model}{title}",
            "  why": printable(one.why),
            "  note": printable(one.note.text) or None,
            "  job": one.job_id,
        }
        print_facts(facts)
        for line in one.messages:
            print_line(f"    {printable(line.text)}")
        if one.more:
            print_line(f"    and {plural(one.more, 'message')} more")
