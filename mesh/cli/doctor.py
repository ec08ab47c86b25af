"""`aira doctor`: checks whether this machine can run a role."""

from __future__ import annotations

from contextlib import aclosing
from typing import TYPE_CHECKING, Any, Final, get_args

import click

from mesh.cli.errors import InvalidOptions
from mesh.cli.options import with_json, with_settings
from mesh.cli.output import plural, print_json, print_line, printable
from mesh.doctor.checks import CheckStatus
from mesh.doctor.context import DoctorContext, Role, SerialSettings, with_identity
from mesh.settings import ChainSettings, NetworkSettings, options_of

if TYPE_CHECKING:
    from mesh.doctor.checks import CompletedCheck
    from mesh.settings import Settings

COLOURS: Final = {CheckStatus.OK: "green", CheckStatus.WARN: "yellow", CheckStatus.FAIL: "red"}
MARK: Final = 6
"""Width of the status column."""


@click.command("doctor")
@click.option(
    "--role",
    type=click.Choice(get_args(Role)),
    help="the role to check this machine for [inferred from the settings]",
)
@click.option(
    "--timeout",
    type=click.FloatRange(0, 600, min_open=True),
    default=15.0,
    show_default=True,
    help="time limit in seconds for all checks together",
)
@click.option("--chain-id", type=click.IntRange(1), help="the expected chain id (EIP-155)")
@click.option("--port", default="", help="for an edge agent: the serial port, as in `aira edge PORT`")
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
    *options_of(NetworkSettings),
    "listen",
    "link",
    "roster",
    "lighthouse_contract",
    "erc20_token",
    "keyfile",
    "keyfile_password_file",
    *options_of(ChainSettings),
    "validator_contract",
    "content_limit",
    "ipfs_http_provider",
    "ipfs_authorization_file",
)
async def command(settings: Settings, as_json: bool, timeout: float, role: Role | None, **options: Any) -> None:
    """Check whether this machine can run a role, and suggest a fix for each problem.

    Checks the router and this identity's rights there, the clocks, the chain and its contracts, the account and its
    balances, and the disk; for a bridge also the IPFS daemon, for an edge agent the serial port and its board (opening
    the port resets most boards). Changes and spends nothing, and shows no key or password.

    Prints a line for each check: ok, warn (it works now) or FAIL; with --json an object with name, ok, found, do and
    code. A check that depends on a failed one is skipped. The exit code is 1 if a check fails.
    """
    context = _context_of(settings, role, **options)
    if await _examine(context, seconds=timeout, as_json=as_json):
        raise click.exceptions.Exit(1)


def _context_of(settings: Settings, role: Role | None, **options: Any) -> DoctorContext:
    """The context to check. Raises `InputError` for options that can't be combined."""
    agent, device = options["agent"], options["device"]
    if bool(agent) != bool(device):
        raise InvalidOptions("--agent and --device must be given together")
    return with_identity(
        DoctorContext(
            settings=settings,
            requested_role=role,
            agent=agent,
            device=device,
            serial=SerialSettings(port=options["port"], protocol=options["protocol"], baud=options["baud"] or 0),
            chain_id=options["chain_id"] or 0,
        )
    )


async def _examine(context: DoctorContext, *, seconds: float, as_json: bool) -> list[str]:
    """Run the checks, and print each result; returns the names of the failed ones."""
    from mesh.doctor import checks_for, run_checks

    by_status: dict[CheckStatus, list[str]] = {status: [] for status in CheckStatus}
    skipped: list[str] = []
    async with checks_for(context) as checks, aclosing(run_checks(checks, seconds=seconds)) as completed:
        width = max(len(check.name) for check in checks)
        async for checked in completed:
            if checked.result is None:
                skipped.append(checked.name)
                continue
            by_status[checked.result.status].append(checked.name)
            if as_json:
                _print_object(context, checked)
            else:
                _print_result(context, checked, width)
    if not as_json:
        _print_summary(context, len(checks), by_status, skipped)
    return by_status[CheckStatus.FAIL]


def _print_object(context: DoctorContext, checked: CompletedCheck) -> None:
    assert checked.result is not None
    result = checked.result
    found, do = (context.without_secrets(text) for text in (result.message, result.hint))
    print_json({"name": checked.name, "ok": result.ok, "found": found, "do": do, "code": result.code})


def _print_result(context: DoctorContext, checked: CompletedCheck, width: int) -> None:
    assert checked.result is not None
    status, _, found, do = checked.result
    mark = click.style(f"{status.value:<{MARK}}", fg=COLOURS[status], bold=status is CheckStatus.FAIL)
    print_line(f"{mark}{checked.name:<{width}}  {printable(context.without_secrets(found))}")
    if do:
        print_line(f"{'':<{MARK + width}}  -> {printable(context.without_secrets(do))}")


def _print_summary(
    context: DoctorContext, count: int, by_status: dict[CheckStatus, list[str]], skipped: list[str]
) -> None:
    failed, warned = by_status[CheckStatus.FAIL], by_status[CheckStatus.WARN]
    print_line()
    if skipped:
        print_line(f"skipped because of an earlier failure: {', '.join(skipped)}")
    if failed:
        print_line(f"{len(failed)} of {plural(count, 'check')} failed for the role {context.role}: {', '.join(failed)}")
    else:
        warnings = f"; with warnings: {', '.join(warned)}" if warned else ""
        print_line(f"all {count} checks passed for the role {context.role}{warnings}")
