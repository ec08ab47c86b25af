"""`aira robot`: shows and changes how a robot works while it runs, stops it and releases it, for its owner.
`aira stop`: stops all robots of this machine, without router or chain.
"""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Any

import click
import msgspec

from mesh.cli.chain_client import own_address
from mesh.cli.options import AmountText, with_json, with_settings
from mesh.cli.output import plural, print_facts, print_json, print_line, printable
from mesh.errors import ConfigurationError, InputError, RemoteError
from mesh.settings import NetworkSettings
from schemas.records import ControlRobot, RobotControl
from schemas.signing import LONGEST_WHY

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from mesh.settings import Settings
    from schemas.records import NotifyTarget


@click.group("robot")
def command() -> None:
    """Change how a robot works while it runs: its price, whom it refuses, whether it takes jobs.

    ROBOT is its name or its address; without it, that of the keyfile, or the only robot that runs here with this data
    folder. Whoever may write to that folder may do this, without a router. A robot elsewhere is asked through the
    router: only if it has `open_services`, and on a closed site only by operators.
    """


def _of_robot(function: Callable[..., Any]) -> Callable[..., Any]:
    """Give a command ROBOT, `--json` and its settings."""
    decorated = with_json(with_settings(NetworkSettings, "lighthouse_contract", "keyfile", "data_dir")(function))
    return click.argument("robot", required=False)(decorated)


@command.command("show", short_help="show how a robot works")
@_of_robot
async def show(settings: Settings, robot: str | None, as_json: bool) -> None:
    """Show what is in effect on ROBOT."""
    await _control(settings, robot, ControlRobot(), as_json=as_json)


@command.command("set", short_help="change how a robot works")
@click.option("--price", help="what a job costs, in its profile and its quotes (6); '' for that of its model")
@click.option("--paused", type=bool, metavar="true|false", help="take no new jobs")
@click.option("--refuse", multiple=True, metavar="ADDRESS", help="the only customers that it refuses; '' for nobody")
@click.option("--least-price", help="least cost of a job that it takes (1.5); '' for any")
@_of_robot
async def change(settings: Settings, robot: str | None, as_json: bool, refuse: tuple[str, ...], **given: Any) -> None:
    """Change what is given on ROBOT, for this run and later ones. It counts instead of the robot's settings.

    A paused robot withdraws its offers; what is a contract goes on. Jobs below the price are not declined: that is
    what the least price is for.
    """
    for name in ("price", "least_price"):
        if given[name]:
            AmountText().convert(given[name], None, None)
    refused = tuple(filter(None, refuse)) if refuse else None
    await _control(settings, robot, ControlRobot(refuse=refused, **given), as_json=as_json)


@command.command("stop", short_help="stop a robot")
@click.option("--why", default="stopped by its owner", show_default=True, help="for people: at most 200 characters")
@_of_robot
async def stop(settings: Settings, robot: str | None, as_json: bool, why: str) -> None:
    """Stop the jobs of ROBOT, and let it take and begin none until it is released. WHY becomes public.

    `aira stop` stops all robots and devices of this machine, also without a robot that answers.
    """
    await _control(settings, robot, ControlRobot(stop=why), as_json=as_json)


@command.command("release", short_help="let a stopped robot take and begin jobs again")
@_of_robot
async def release(settings: Settings, robot: str | None, as_json: bool) -> None:
    """Let ROBOT, which was stopped, take and begin jobs again. What `aira stop` has stopped, it releases itself."""
    await _control(settings, robot, ControlRobot(release=True), as_json=as_json)


async def _control(settings: Settings, robot: str | None, asked: ControlRobot, *, as_json: bool) -> None:
    """Let a robot do what its owner wants, and print what is in effect."""
    from mesh.role.local_stop import control_here, stop_folder

    folder = stop_folder(settings)
    named = await _address(settings, robot) if robot else own_address(settings)
    address = named or _only_one(folder)
    control = await asyncio.to_thread(control_here, folder, address, asked)
    if control is None and named is None:  # it was killed
        raise _nobody()
    if control is None:
        control = await _ask_elsewhere(settings, address, asked)
    if as_json:
        print_json({"robot": address, **msgspec.to_builtins(control)})
        return
    takes = "no jobs: it was stopped" if control.held else "no jobs: it is paused" if control.paused else "jobs"
    facts = {
        "robot": address,
        "price": printable(control.price) or "none",
        "takes": takes,
        "refuses": printable(", ".join(control.refuse)) or "nobody",
        "least price": printable(control.least_price) or "any",
        "tells": printable(", ".join(map(_target, control.notify))) or "nobody",
        "done": printable(control.stopped) or None,
    }
    print_facts(facts)


def _target(one: NotifyTarget) -> str:
    return f"{one.target} ({plural(one.waiting, 'event')} waiting)" if one.waiting else one.target


async def _address(settings: Settings, robot: str) -> str:
    from mesh.role.composition import watching
    from mesh.watching.robots import robot_address
    from schemas import parse_address

    if robot[:2].lower() == "0x":
        return parse_address(robot)
    async with watching(settings) as (network, channel):
        return await robot_address(network.session, channel, robot)


def _only_one(folder: Path) -> str:
    from mesh.role.local_stop import agents_here

    if len(found := agents_here(folder)) == 1:
        return found[0]
    if not found:
        raise _nobody()
    names = ", ".join(found)
    raise InputError(f"{len(found)} robots run here: {names}", hint="name one of them", code="robot-ambiguous")


def _nobody() -> InputError:
    hint = "name its data folder with --data-dir, or name the robot"
    return InputError("no robot runs here with this data folder", hint=hint, code="robot-unknown")


async def _ask_elsewhere(settings: Settings, address: str, asked: ControlRobot) -> RobotControl:
    from mesh.network import Endpoints, Network, call

    async with Network(Endpoints.from_settings(settings)) as network:
        control = await call(network.session, address, "control", asked)
    assert isinstance(control, RobotControl)
    return control


@click.command("stop")
@click.argument("why", default="stopped on the robot's machine")
@click.option("--release", "is_release", is_flag=True, help="let stopped robots take and begin jobs again")
@with_json
@with_settings("data_dir")
def stop_all(settings: Settings, *, why: str, is_release: bool, as_json: bool) -> None:
    """Stop the agents and the devices (`aira edge`) of this machine that use the same data folder. It needs no router
    and no chain.

    Devices hear the stop, and the jobs that have begun end with the code `robot-stopped`; WHY becomes public with their
    recordings. No agent of the data folder takes or begins a job until `aira stop --release`, also after a restart.
    Jobs that had not begun wait.

    The exit code is 1 if an agent or a device could not stop, or none is running.
    """
    from mesh.role.local_stop import hold_all, release, stop_folder, stop_here

    folder = stop_folder(settings)
    if len(why) > LONGEST_WHY:
        raise InputError(f"the reason has {len(why)} characters, the most are {LONGEST_WHY}", code="why-too-long")
    try:
        if is_release:
            count = release(folder)
            print_json({"released": count > 0}) if as_json else print_line("released" if count else "nothing was held")
            return
        hold_all(folder, why)
    except OSError as error:
        raise ConfigurationError(
            f"can't write to {folder}: {error.strerror}", hint="run it as the user of the agent, with its --data-dir"
        ) from None
    answers = stop_here(folder, why)
    if as_json:
        print_json({"answers": answers})
    else:
        for answer in answers:
            print_line(f"{printable(answer.who)}: {printable(answer.detail) or 'stopped'}")
        print_line("no job begins before `aira stop --release`")
    if not answers:
        hint = "name its data folder with --data-dir; a robot elsewhere is stopped by `aira liability stop`"
        raise RemoteError("no agent and no device runs here with this data folder", hint=hint, code="nothing-to-stop")
    if missed := [answer for answer in answers if not answer.heard]:
        who = ", ".join(printable(answer.who) for answer in missed)
        raise RemoteError(f"not stopped: {who}", hint="cut its power", code="not-stopped")
