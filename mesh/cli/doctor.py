"""`aira doctor`: checks whether this machine can run a role."""

from __future__ import annotations

from contextlib import aclosing
from dataclasses import replace
from typing import TYPE_CHECKING, Final, Literal, get_args

import click

from mesh.cli.options import FiniteRange, with_json, with_settings
from mesh.cli.output import plural, print_json, print_line, printable
from mesh.errors import InputError
from mesh.ops.doctor.checks import CheckStatus, DoctorContext, Role, SerialSettings, with_identity
from mesh.settings import AccountSettings, ChainSettings, NetworkSettings

if TYPE_CHECKING:
    from mesh.settings import Settings

COLOURS: Final = {CheckStatus.OK: "green", CheckStatus.WARN: "yellow", CheckStatus.FAIL: "red"}


@click.command("doctor")
@click.option(
    "--role", type=click.Choice(get_args(Role)), help="the role to check this machine for [inferred from the settings]"
)
@click.option(
    "--timeout",
    type=FiniteRange(0, 600, min_open=True),
    default=15.0,
    show_default=True,
    help="time limit in seconds for all checks together",
)
@click.option("--chain-id", type=click.IntRange(1), help="the expected chain id (EIP-155)")
@click.option(
    "--tty", "port", default="", metavar="PORT", help="for an edge agent: the serial port, as in `aira edge PORT`"
)
@click.option(
    "--protocol",
    type=click.Choice(["auto", "frames", "rosserial"]),
    default="auto",
    help="for an edge agent: the protocol of the board; it is found by default",
)
@click.option(
    "--baud",
    type=click.IntRange(300, 4_000_000),
    default=None,
    help="for an edge agent: bits per second of the port; they are found by default",
)
@click.option("--agent", default="", help="for an edge agent: address of the agent that its device belongs to")
@click.option("--device", default="", help="for an edge agent: name of that device")
@with_json
@with_settings(
    NetworkSettings,
    "listen",
    "link",
    "roster",
    "lighthouse_contract",
    "erc20_token",
    AccountSettings,
    ChainSettings,
    "validator_contract",
    "content_limit",
    "ipfs_http_provider",
    "ipfs_authorization_file",
)
async def command(
    settings: Settings,
    *,
    role: Role | None,
    timeout: float,
    chain_id: int | None,
    port: str,
    protocol: Literal["auto", "frames", "rosserial"],
    baud: int | None,
    agent: str,
    device: str,
    as_json: bool,
) -> None:
    """Check whether this machine can run a role, and suggest a fix for each problem.

    Checks the router and this identity's rights there, the clocks, the chain and its contracts, the account and its
    balances, and the disk; for a bridge also the IPFS daemon, for an edge agent the serial port and its board (opening
    the port resets most boards). Changes and spends nothing, and shows no key or password.

    Prints a line for each check: ok, warn (it works now) or FAIL; with --json an object with name, ok, found, do and
    code. A check that depends on a failed one is skipped. The exit code is 1 if a check fails.
    """
    from mesh.ops.doctor import checks_for, run_checks

    if bool(agent) != bool(device):
        raise InputError("--agent and --device must be given together", code="invalid-options")
    serial = SerialSettings(port=port, protocol=protocol, baud=baud or 0)
    named = DoctorContext(settings=settings, requested_role=role, agent=agent, device=device, serial=serial)
    context = with_identity(replace(named, chain_id=chain_id or 0))
    by_status: dict[CheckStatus, list[str]] = {status: [] for status in CheckStatus}
    skipped: list[str] = []
    async with checks_for(context) as checks, aclosing(run_checks(checks, seconds=timeout)) as completed:
        width, margin = max(len(check.name) for check in checks), 6
        async for name, result in completed:
            if result is None:
                skipped.append(name)
                continue
            by_status[result.status].append(name)
            found, do = (context.without_secrets(text) for text in (result.message, result.hint))
            if as_json:
                print_json({"name": name, "ok": result.ok, "found": found, "do": do, "code": result.code})
                continue
            is_failed = result.status is CheckStatus.FAIL
            mark = click.style(f"{result.status.value:<{margin}}", fg=COLOURS[result.status], bold=is_failed)
            print_line(f"{mark}{name:<{width}}  {printable(found)}")
            if do:
                print_line(f"{'':<{margin + width}}  -> {printable(do)}")
    failed, warned = by_status[CheckStatus.FAIL], by_status[CheckStatus.WARN]
    if not as_json:
        print_line()
        if skipped:
            print_line(f"skipped because of an earlier failure: {', '.join(skipped)}")
        if failed:
            of = plural(len(checks), "check")
            print_line(f"{len(failed)} of {of} failed for the role {context.role}: {', '.join(failed)}")
        else:
            warnings = f"; with warnings: {', '.join(warned)}" if warned else ""
            print_line(f"all {len(checks)} checks passed for the role {context.role}{warnings}")
    if failed:
        raise click.exceptions.Exit(1)
