"""`aira doctor`: checks whether this machine can run a role."""

from __future__ import annotations

import sys
from contextlib import aclosing
from typing import TYPE_CHECKING, Any, Final, get_args

import click

from mesh.cli.errors import InvalidOptions
from mesh.cli.options import with_json, with_settings
from mesh.cli.output import plural, print_json, print_line, printable
from mesh.doctor.checks import CheckStatus
from mesh.doctor.context import DoctorContext, Role, SerialSettings, with_identity
from mesh.errors import AiraError
from mesh.running import fail, run_to_end
from mesh.settings import ChainSettings, NetworkSettings, options_of

if TYPE_CHECKING:
    from mesh.doctor.checks import CompletedCheck
    from mesh.settings import Settings

COLOURS: Final = {CheckStatus.OK: "green", CheckStatus.WARN: "yellow", CheckStatus.FAIL: "red"}
MARK: Final = 6
"""Columns of the status before each line."""


@click.command("doctor")
@click.option(
    "--role",
    type=click.Choice(get_args(Role)),
    help="the role that this machine should run [inferred from the settings]",
)
@click.option(
    "--timeout",
    type=click.FloatRange(0, 600, min_open=True),
    default=15.0,
    show_default=True,
    help="seconds for all checks together",
)
@click.option("--chain-id", type=click.IntRange(1), help="the chain id that the node should have (EIP-155)")
@click.option("--port", default="", help="for an edge agent: its serial port, as in `aira edge PORT`")
@click.option(
    "--protocol", type=click.Choice(["frames", "rosserial"]), default="frames", help="the protocol of its board"
)
@click.option("--baud", type=click.IntRange(300, 4_000_000), default=57_600, help="bits per second of its port")
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
    "content_limit",
    "ipfs_http_provider",
    "ipfs_authorization_file",
)
def command(settings: Settings, as_json: bool, timeout: float, role: Role | None, **options: Any) -> None:
    """Look at everything that a role needs on this machine, and say what is wrong and what to do about it.

    The router and what it lets this identity do, the clocks, the chain and its contracts, the account and its money,
    the disk; for a bridge also the IPFS daemon, for an edge agent the serial port and its board (which opening the port
    starts anew). Nothing is changed or spent, and no key or password is shown.

    A line for each check: ok, warn (it works now) or FAIL. With --json an object for each: name, ok, found, do. What
    can't be tried because of a failure before it is left out. Exits 1 if anything fails.
    """
    try:
        context = _case(settings, role, **options)
    except AiraError as error:
        fail(error)
    failed: list[str] = []
    run_to_end(lambda: _examine(context, failed, seconds=timeout, as_json=as_json))
    if failed:
        sys.exit(1)


def _case(settings: Settings, role: Role | None, **options: Any) -> DoctorContext:
    """Who is examined. Raises `InputError` for options that can't be meant together."""
    agent, device = options["agent"], options["device"]
    if bool(agent) != bool(device):
        raise InvalidOptions("--agent and --device go together, and one is missing")
    return with_identity(
        DoctorContext(
            settings=settings,
            requested_role=role,
            agent=agent,
            device=device,
            serial=SerialSettings(port=options["port"], protocol=options["protocol"], baud=options["baud"]),
            chain_id=options["chain_id"] or 0,
        )
    )


async def _examine(context: DoctorContext, failed: list[str], *, seconds: float, as_json: bool) -> None:
    """Make the checks and tell each; the names of those that fail go into `failed`."""
    from mesh.doctor import checks_for, run_checks

    by_status: dict[CheckStatus, list[str]] = {status: [] for status in CheckStatus}
    left_out: list[str] = []
    async with checks_for(context) as checks, aclosing(run_checks(checks, seconds=seconds)) as examined:
        width = max(len(check.name) for check in checks)
        async for checked in examined:
            if checked.result is None:
                left_out.append(checked.name)
                continue
            by_status[checked.result.status].append(checked.name)
            if as_json:
                _print_object(context, checked)
            else:
                _say_line(context, checked, width)
    if not as_json:
        _sum_up(context, len(checks), by_status, left_out)
    failed += by_status[CheckStatus.FAIL]


def _print_object(context: DoctorContext, checked: CompletedCheck) -> None:
    assert checked.result is not None
    found, do = (context.without_secrets(text) for text in checked.result[1:])
    print_json({"name": checked.name, "ok": checked.result.ok, "found": found, "do": do})


def _say_line(context: DoctorContext, checked: CompletedCheck, width: int) -> None:
    assert checked.result is not None
    status, found, do = checked.result
    mark = click.style(f"{status.value:<{MARK}}", fg=COLOURS[status], bold=status is CheckStatus.FAIL)
    print_line(f"{mark}{checked.name:<{width}}  {printable(context.without_secrets(found))}")
    if do:
        print_line(f"{'':<{MARK + width}}  -> {printable(context.without_secrets(do))}")


def _sum_up(context: DoctorContext, count: int, by_status: dict[CheckStatus, list[str]], left_out: list[str]) -> None:
    failed, warned = by_status[CheckStatus.FAIL], by_status[CheckStatus.WARN]
    print_line()
    if left_out:
        print_line(f"not tried, because of a failure before: {', '.join(left_out)}")
    if failed:
        print_line(f"{plural(len(failed), 'check')} of {count} failed for the role {context.role}: {', '.join(failed)}")
    else:
        warnings = f"; with a warning: {', '.join(warned)}" if warned else ""
        print_line(f"all {count} checks are in order for the role {context.role}{warnings}")
