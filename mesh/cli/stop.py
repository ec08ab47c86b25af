"""`aira stop`: stops the robots of this machine, without router or chain."""

from __future__ import annotations

from typing import TYPE_CHECKING

import click

from mesh.cli.options import with_json, with_settings
from mesh.cli.output import print_json, print_line, printable
from mesh.errors import ConfigurationError, InputError, RemoteError
from schemas.signing import LONGEST_WHY

if TYPE_CHECKING:
    from mesh.settings import Settings


@click.command("stop", short_help="stop the robots of this machine, or release them")
@click.argument("why", default="stopped on the robot's machine")
@click.option("--release", "is_release", is_flag=True, help="let stopped robots take and begin jobs again")
@with_json
@with_settings("data_dir")
def command(settings: Settings, *, why: str, is_release: bool, as_json: bool) -> None:
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
        raise RemoteError(
            f"not stopped: {who}",
            hint="cut its power",
            code="not-stopped",
        )
