"""`aira edge`: connect a device on a serial line to its agent."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import click

from bridges.serial.dialect import AUTO, dialect_names
from mesh.cli.options import FiniteRange, with_settings
from mesh.errors import AiraError, InputError
from mesh.role.running import fail
from mesh.settings import EdgeSettings, NetworkSettings, TelemetrySettings
from mesh.telemetry.logs import configure_logging_from
from schemas.keys import topic_chunks

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from mesh.settings import Settings


def _renaming(context: click.Context, option: click.Parameter, given: tuple[str, ...]) -> tuple[tuple[str, str], ...]:
    """Parse TOPIC=NAME into pairs."""
    pairs = tuple(text.partition("=")[::2] for text in given)
    for text, (topic, name) in zip(given, pairs, strict=True):
        if not topic.startswith("/") or not name.startswith("/"):
            raise click.BadParameter(f"{text!r} is not /TOPIC=/NAME")
    return pairs


class BaudRate(click.IntRange):
    """Bits per second; 0, which users write as `auto`, is for those that have to be found."""

    def __init__(self) -> None:
        super().__init__(300, 4_000_000)

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> int:
        return 0 if value in (0, AUTO) else int(super().convert(value, param, ctx))


def topic_names(renamed: Iterable[tuple[str, str]] = ()) -> Callable[[str], str]:
    """A function that gives a board's topics their names in the mesh, by pairs of the board's name and the mesh's.

    A pair also renames all topics below it, and `/` stands for all topics: `("/", "/left")` maps `/led` to `/left/led`.
    If several pairs match, the longest one applies. Raises `InvalidKey` for a text that is no topic, and `InputError`
    for one that is renamed twice.
    """
    names: dict[str, str] = {}
    for topic, other in renamed:
        if (prefix := _prefix(topic)) in names:
            raise InputError(f"{topic} is given two names")
        names[prefix] = _prefix(other)

    def name_of(topic: str) -> str:
        prefix = topic
        while prefix not in names:
            if not prefix:
                return topic
            prefix = prefix.rpartition("/")[0]
        return names[prefix] + topic[len(prefix) :] or topic

    return name_of


def _prefix(name: str) -> str:
    """The beginning of the names of a topic and of all topics below it; empty for `/`."""
    return "" if name == "/" else topic_chunks(name)


def _parameter(context: click.Context, option: click.Parameter, given: tuple[str, ...]) -> dict[str, object]:
    """Parse NAME=VALUE; values become numbers if possible, and lists if they contain commas."""
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
@click.option("--agent", required=True, metavar="ADDRESS", help="address of the agent that the device belongs to")
@click.option("--name", default="board", show_default=True, help="name of the device in the agent's keys")
@click.option(
    "--protocol",
    type=click.Choice([AUTO, *dialect_names()]),
    default=AUTO,
    show_default=True,
    help="protocol of the firmware: frames (this project's), rosserial (version 2), or an installed one; auto finds "
    "one of the first two",
)
@click.option("--baud", type=BaudRate(), default=AUTO, show_default=True, help="bits per second; auto finds them")
@click.option(
    "--patience",
    type=FiniteRange(0, 3600),
    default=30.0,
    show_default=True,
    help="seconds for which a command waits while the board is absent or busy",
)
@click.option(
    "--param",
    "parameters",
    multiple=True,
    metavar="NAME=VALUE",
    callback=_parameter,
    help="parameter for a rosserial sketch; separate several values by commas (may be repeated)",
)
@click.option(
    "--map",
    "renamed",
    multiple=True,
    metavar="TOPIC=NAME",
    callback=_renaming,
    help="rename a topic of the board and all topics below it, as in /led=/left/led or /=/left (may be repeated)",
)
@with_settings(NetworkSettings, TelemetrySettings, EdgeSettings, "data_dir")
def command(settings: Settings, renamed: tuple[tuple[str, str], ...], **options: Any) -> None:
    """Connect the device at PORT to its agent. Ctrl-C stops it.

    Protocol and baud rate are found by trying, which takes a few seconds: the board gets questions in several protocols
    and at several speeds. If it has firmware of another kind, state both.

    PORT is a path (/dev/ttyACM0, or a stable one under /dev/serial/by-id) or a USB id (usb:2341:0043, with a serial
    number appended if there are several such devices). If the port is missing or unplugged, the command waits for it.

    A command on a topic of a job reaches all devices of the agent that have a topic of that name. Use --map to rename
    the topics of this device.
    """
    from bridges.serial._edge import Edge, EdgeOptions, run_edge, serve_metrics
    from mesh.network.endpoints import Endpoints

    configure_logging_from(settings, "edge")
    endpoints = Endpoints.from_settings(settings)
    try:
        edge = Edge(EdgeOptions(**options, rename=topic_names(renamed), agent_silence=settings.agent_silence))
        with serve_metrics(edge, settings.metrics_listen):
            run_edge(edge, settings, endpoints)
    except AiraError as error:
        fail(error)
