"""`aira health`: how a server on this machine is, or another one whose metrics can be reached."""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING, Final
from urllib.parse import urlsplit

import click

from mesh.cli.options import with_json, with_settings
from mesh.cli.output import print_facts, print_json, printable
from mesh.errors import AiraError, ConfigurationError, RemoteError
from mesh.running import fail

if TYPE_CHECKING:
    from mesh.settings import Settings
    from mesh.telemetry.health import Health

ANYWHERE: Final = {"0.0.0.0": "127.0.0.1", "::": "::1"}
"""Where who listens everywhere is asked."""
LONGEST: Final = 65_536
"""Bytes of an answer at most."""


@click.command("health")
@click.option("--url", help="whom to ask, as http://HOST:PORT [where the settings' metrics_listen is]")
@click.option(
    "--timeout", type=click.FloatRange(min=0, min_open=True), default=8.0, show_default=True, help="seconds to wait"
)
@with_json
@with_settings("metrics_listen")
def command(settings: Settings, url: str | None, timeout: float, as_json: bool) -> None:
    """Show how a server is: the state of each of its parts. It has to be run with --metrics-listen HOST:PORT.

    The exit code is 0 if all parts are alive, and 1 if one is not or nobody answers, as a check of a container's health
    wants it.
    """
    try:
        host, port = _place(url, settings)
        health = _asked(host, port, timeout=timeout)
    except AiraError as error:
        fail(error)
    if as_json:
        print_json(health)
    else:
        print_facts({printable(part): printable(state) for part, state in health.parts.items()})
    sys.exit(0 if health.ok else 1)


def _place(url: str | None, settings: Settings) -> tuple[str, int]:
    """Host and port of whom to ask. Raises `ConfigurationError`."""
    from mesh.telemetry.health import listen_address

    if url is not None:
        return _place_of(url)
    if not settings.metrics_listen:
        raise ConfigurationError(
            "nothing says where the server tells its health",
            hint="give --url http://HOST:PORT, or the metrics_listen that the server was given",
        )
    host, port = listen_address(settings.metrics_listen)
    return ANYWHERE.get(host, host), port


def _place_of(url: str) -> tuple[str, int]:
    try:
        parts = urlsplit(url)
        found = parts.hostname, parts.port
    except ValueError:
        parts, found = None, (None, None)
    if parts is None or parts.scheme != "http" or not found[0] or not found[1]:
        raise ConfigurationError(f"{url!r} is not the address of a server", hint="give --url http://HOST:PORT")
    return found[0], found[1]


def _asked(host: str, port: int, *, timeout: float) -> Health:
    """What the server answers. Raises `RemoteError`."""
    from http.client import HTTPConnection, HTTPException

    import msgspec

    from mesh.telemetry.health import Health

    connection = HTTPConnection(host, port, timeout=timeout)
    where = f"{host}:{port}"
    try:
        connection.request("GET", "/health")
        return Health.decode(connection.getresponse().read(LONGEST))
    except (OSError, HTTPException, UnicodeError) as error:
        why = getattr(error, "strerror", None) or str(error) or type(error).__name__
        raise RemoteError(
            f"nobody tells its health at {where}: {why}",
            hint="does the server run, and with --metrics-listen HOST:PORT?",
        ) from None
    except msgspec.MsgspecError:
        raise RemoteError(f"what answers at {where} is no server of the mesh", hint="give its --url") from None
    finally:
        connection.close()
