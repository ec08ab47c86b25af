"""`aira logs`: reads the log of an agent, a provider, a bridge or a device over the mesh."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Any, Final

import click

from mesh.cli.options import with_json, with_settings, with_timeout
from mesh.cli.output import plural, print_line, printable, wait_for_broken_pipe
from mesh.settings import NetworkSettings
from schemas import parse_address
from schemas.keys import DeviceTopicKey, RpcKey
from schemas.status import LEVELS

if TYPE_CHECKING:
    from collections.abc import Callable

    from mesh.settings import Settings
    from mesh.watching.presence import LogReader, LogUpdate
    from schemas.status import LogEvent

POLL_INTERVAL: Final = 0.5
"""Seconds between two requests for new events."""


@click.command("logs")
@click.argument("address")
@click.option("--device", help="show the log of the edge agent that serves this device")
@click.option("--follow", "-f", is_flag=True, help="also show new events until Ctrl-C")
@click.option(
    "--lines",
    "-n",
    type=click.IntRange(min=0),
    default=100,
    show_default=True,
    help="number of past events to show",
)
@click.option(
    "--level", type=click.Choice(LEVELS[:-1]), default="debug", show_default=True, help="lowest level to show"
)
@click.option("--liability", default="", metavar="ADDRESS", help="show only events of this liability")
@with_timeout()
@with_json
@with_settings(NetworkSettings)
async def command(
    settings: Settings,
    address: str,
    device: str | None,
    follow: bool,
    lines: int,
    level: str,
    liability: str,
    timeout: float,
    as_json: bool,
) -> None:
    """Show the latest log events of the agent, provider, validator or bridge with ADDRESS.

    Each keeps its last 2,000 events of its log_level or above. --json prints one object per line, in the format that
    log_format = "json" selects.
    """
    from mesh.base.background import Background
    from mesh.network import Endpoints, Network, no_answer
    from mesh.telemetry.logs import human_line, json_line
    from mesh.watching.presence import LogReader

    agent, line = parse_address(address), json_line if as_json else human_line
    wanted: dict[str, Any] = {"lines": lines, "level": level, "liability": liability and parse_address(liability)}
    # An edge agent serves its device's log on the topic `/log`.
    key = str(RpcKey(agent, "logs") if device is None else DeviceTopicKey(agent, device, "/log"))
    async with Network(Endpoints.from_settings(settings)) as network, Background() as tasks:
        tasks.start(wait_for_broken_pipe(), "readers of stdout")
        reader = LogReader(network.session, key, **wanted)
        update = await reader.poll(timeout=timeout)
        if not update.answered:
            raise no_answer(agent, "logs", device=device or "")
        _print_update(update, line)
        while update.more:
            update = await reader.poll(timeout=timeout)
            _print_update(update, line)
        if follow:
            await _follow(reader, line, timeout=timeout)


async def _follow(reader: LogReader, line: Callable[[LogEvent], str], *, timeout: float) -> None:
    """Show new events. Prints to stderr when it stops answering, and when it answers again."""
    from mesh.network import ServiceFailed
    from mesh.watching.presence import LogUpdate

    reported = ""
    while True:
        await asyncio.sleep(POLL_INTERVAL)
        try:
            update = await reader.poll(timeout=timeout)
            failure = "" if update.answered else "no answer; waiting"
        except ServiceFailed as error:
            update, failure = LogUpdate([]), printable(str(error))
        if failure != reported:
            _note(failure or "answering again")
            reported = failure
        _print_update(update, line)


def _print_update(update: LogUpdate, line: Callable[[LogEvent], str]) -> None:
    for began in update.began:
        _note(f"restarted at {printable(began)}")
    if update.missed:
        _note(f"missed {plural(update.missed, 'event')}: they arrived faster than they could be read")
    for event in update.events:
        print_line(line(event))


def _note(words: str) -> None:
    click.echo(f"aira: {words}", err=True)
