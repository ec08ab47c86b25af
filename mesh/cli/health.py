"""`aira health`: requests a server's health, as a container's health check does."""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING, Final
from urllib.parse import urlsplit

import click

from mesh.cli.options import with_json, with_settings, with_timeout
from mesh.cli.output import print_facts, print_json, printable
from mesh.errors import ConfigurationError, RemoteError

if TYPE_CHECKING:
    from mesh.settings import Settings
    from mesh.telemetry.metrics import Health

LOOPBACK_OF: Final = {"0.0.0.0": "127.0.0.1", "::": "::1"}
"""The address at which to reach a server that listens on all interfaces."""


@click.command("health")
@click.option("--url", help="address of the server, http://HOST:PORT [the settings' metrics_listen]")
@with_timeout(8.0)
@with_json
@with_settings("metrics_listen")
def command(settings: Settings, url: str | None, timeout: float, as_json: bool) -> None:
    """Show the state of each part of a server that runs with --metrics-listen HOST:PORT.

    The exit code is 0 if all parts are alive, and 1 if one is not or the server does not answer, as container health
    checks expect.
    """
    health = _fetch_health(*_server_address(url, settings), timeout=timeout)
    if as_json:
        print_json(health)
    else:
        print_facts({printable(part): printable(state) for part, state in health.parts.items()})
    sys.exit(0 if health.ok else 1)


def _server_address(url: str | None, settings: Settings) -> tuple[str, int]:
    """Host and port of the server. Raises `ConfigurationError`."""
    from mesh.telemetry.metrics import listen_address

    if url is not None:
        try:
            parts = urlsplit(url)
            if parts.scheme == "http" and parts.hostname and parts.port:
                return parts.hostname, parts.port
        except ValueError:
            pass
        raise ConfigurationError(
            f"{url!r} is not a server address", hint="give --url http://HOST:PORT", code="invalid-server-address"
        )
    if not settings.metrics_listen:
        raise ConfigurationError(
            "the address of the server is missing",
            hint="give --url http://HOST:PORT, or the same metrics_listen as the server",
            code="invalid-server-address",
        )
    host, port = listen_address(settings.metrics_listen)
    return LOOPBACK_OF.get(host, host), port


def _fetch_health(host: str, port: int, *, timeout: float) -> Health:
    """The server's answer. Raises `RemoteError`."""
    from http.client import HTTPConnection, HTTPException

    from mesh.telemetry.metrics import Health
    from schemas.decoding import InvalidData

    connection = HTTPConnection(host, port, timeout=timeout)
    where = f"{host}:{port}"
    try:
        connection.request("GET", "/health")
        return Health.decode(connection.getresponse().read(65_536))
    except (OSError, HTTPException, UnicodeError) as error:
        why = getattr(error, "strerror", None) or str(error) or type(error).__name__
        raise RemoteError(
            f"no server answers at {where}: {why}",
            hint="check that the server runs with --metrics-listen HOST:PORT",
            code="health-unavailable",
        ) from None
    except InvalidData:
        raise RemoteError(
            f"the answer of the server at {where} is not a health report",
            hint="give the right --url",
            code="health-unavailable",
        ) from None
    finally:
        connection.close()
