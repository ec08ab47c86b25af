"""`aira health`: requests a server's health, as a container's health check does."""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING, Final
from urllib.parse import urlsplit

import click

from mesh.cli.errors import HealthUnavailable, InvalidServerAddress
from mesh.cli.options import with_json, with_settings
from mesh.cli.output import print_facts, print_json, printable
from mesh.errors import AiraError
from mesh.running import fail

if TYPE_CHECKING:
    from mesh.settings import Settings
    from mesh.telemetry.health import Health

LOOPBACK_OF: Final = {"0.0.0.0": "127.0.0.1", "::": "::1"}
"""The address at which to reach a server that listens on all interfaces."""
LARGEST_ANSWER: Final = 65_536
"""The most bytes of an answer that are read."""


@click.command("health")
@click.option("--url", help="address of the server, http://HOST:PORT [the settings' metrics_listen]")
@click.option(
    "--timeout", type=click.FloatRange(min=0, min_open=True), default=8.0, show_default=True, help="seconds to wait"
)
@with_json
@with_settings("metrics_listen")
def command(settings: Settings, url: str | None, timeout: float, as_json: bool) -> None:
    """Show the state of each part of a server that runs with --metrics-listen HOST:PORT.

    The exit code is 0 if all parts are alive, and 1 if one is not or the server does not answer, as container health
    checks expect.
    """
    try:
        host, port = _server_address(url, settings)
        health = _fetch_health(host, port, timeout=timeout)
    except AiraError as error:
        fail(error)
    if as_json:
        print_json(health)
    else:
        print_facts({printable(part): printable(state) for part, state in health.parts.items()})
    sys.exit(0 if health.ok else 1)


def _server_address(url: str | None, settings: Settings) -> tuple[str, int]:
    """Host and port of the server. Raises `ConfigurationError`."""
    from mesh.telemetry.health import listen_address

    if url is not None:
        return _parse_url(url)
    if not settings.metrics_listen:
        raise InvalidServerAddress(
            "the address of the server is missing",
            hint="give --url http://HOST:PORT, or the same metrics_listen as the server",
        )
    host, port = listen_address(settings.metrics_listen)
    return LOOPBACK_OF.get(host, host), port


def _parse_url(url: str) -> tuple[str, int]:
    try:
        parts = urlsplit(url)
        found = parts.hostname, parts.port
    except ValueError:
        parts, found = None, (None, None)
    if parts is None or parts.scheme != "http" or not found[0] or not found[1]:
        raise InvalidServerAddress(f"{url!r} is not a server address", hint="give --url http://HOST:PORT")
    return found[0], found[1]


def _fetch_health(host: str, port: int, *, timeout: float) -> Health:
    """The server's answer. Raises `HealthUnavailable`."""
    from http.client import HTTPConnection, HTTPException

    import msgspec

    from mesh.telemetry.health import Health

    connection = HTTPConnection(host, port, timeout=timeout)
    where = f"{host}:{port}"
    try:
        connection.request("GET", "/health")
        return Health.decode(connection.getresponse().read(LARGEST_ANSWER))
    except (OSError, HTTPException, UnicodeError) as error:
        why = getattr(error, "strerror", None) or str(error) or type(error).__name__
        raise HealthUnavailable(
            f"no server answers at {where}: {why}",
            hint="check that the server runs with --metrics-listen HOST:PORT",
        ) from None
    except msgspec.MsgspecError:
        raise HealthUnavailable(
            f"the answer of the server at {where} is not a health report", hint="give the right --url"
        ) from None
    finally:
        connection.close()
