"""`aira edge`: a device on a serial line becomes part of its agent."""

from __future__ import annotations

from typing import TYPE_CHECKING

import click

from mesh.cli.options import with_settings
from mesh.errors import AiraError
from mesh.running import fail
from mesh.settings import NetworkSettings, TelemetrySettings, options_of
from mesh.telemetry.logs import configure_logging_from

if TYPE_CHECKING:
    from bridges.serial.serving import Protocol
    from mesh.settings import Settings


def _renaming(context: click.Context, option: click.Parameter, given: tuple[str, ...]) -> tuple[tuple[str, str], ...]:
    """The pairs of TOPIC=NAME."""
    pairs = tuple(text.partition("=")[::2] for text in given)
    for text, (topic, name) in zip(given, pairs, strict=True):
        if not topic.startswith("/") or not name.startswith("/"):
            raise click.BadParameter(f"{text!r} is not TOPIC=NAME, each with a / before it")
    return pairs


def _parameter(context: click.Context, option: click.Parameter, given: tuple[str, ...]) -> dict[str, object]:
    """The values of NAME=VALUE: numbers where they are some, and lists where there are commas."""
    parameters: dict[str, object] = {}
    for text in given:
        name, equals, value = text.partition("=")
        if not equals or not name:
            raise click.BadParameter(f"{text!r} is not NAME=VALUE")
        values = [_number(part) for part in value.split(",")]
        parameters[name] = values[0] if len(values) == 1 else values
    return parameters


def _number(text: str) -> int | float | str:
    for kind in (int, float):
        try:
            return kind(text)
        except ValueError:
            continue
    return text


@click.command("edge", short_help="connect a device on a serial line to the mesh")
@click.argument("port")
@click.option("--agent", required=True, metavar="ADDRESS", help="account of the agent that the device belongs to")
@click.option("--name", default="board", show_default=True, help="what the device is called among the agent's keys")
@click.option(
    "--protocol",
    type=click.Choice(["frames", "rosserial"]),
    default="frames",
    show_default=True,
    help="what the firmware speaks: our own frames, or rosserial version 2",
)
@click.option("--baud", type=click.IntRange(300, 4_000_000), default=57_600, show_default=True, help="bits per second")
@click.option(
    "--patience",
    type=click.FloatRange(0, 3600),
    default=30.0,
    show_default=True,
    help="seconds that a command waits for a board that is not there, or busy",
)
@click.option(
    "--param",
    "parameters",
    multiple=True,
    metavar="NAME=VALUE",
    callback=_parameter,
    help="a parameter that a rosserial sketch may ask for; several values with commas",
)
@click.option(
    "--map",
    "renamed",
    multiple=True,
    metavar="TOPIC=NAME",
    callback=_renaming,
    help="what the board's topic, or all beneath it, is called in the mesh: /led=/left/led, /=/left",
)
@with_settings(*options_of(NetworkSettings), *options_of(TelemetrySettings))
def command(
    settings: Settings,
    port: str,
    agent: str,
    name: str,
    protocol: Protocol,
    baud: int,
    patience: float,
    parameters: dict[str, object],
    renamed: tuple[tuple[str, str], ...],
) -> None:
    """Bring the device at PORT into the mesh. Ctrl-C ends it.

    PORT is a path (/dev/ttyACM0, or one under /dev/serial/by-id, which stays the same), or a USB id
    (usb:2341:0043, with a serial number behind it if there are several). A port that is not there, or goes away, is
    waited for.

    A command on a topic of a job reaches all of the agent's devices that have a topic of that name; --map gives those
    of this device other names.
    """
    from bridges.serial.device_id import DeviceId
    from bridges.serial.names import Names
    from bridges.serial.serving import Wiring, serve, telling, wait_for_files
    from mesh.network.endpoints import Endpoints

    configure_logging_from(settings, "edge")
    device = DeviceId(agent=agent, name=name)
    endpoints = Endpoints.from_settings(settings)
    try:
        with telling(settings.metrics_listen) as told:
            wait_for_files(settings)
            wiring = Wiring(
                port=port, protocol=protocol, baud=baud, patience=patience, parameters=parameters, names=Names(renamed)
            )
            serve(device, wiring, endpoints=endpoints, told=told)
    except AiraError as error:
        fail(error)
