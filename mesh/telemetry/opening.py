"""What serves metrics and health is loaded here, when the settings say where; it needs no event loop."""

from __future__ import annotations

from typing import TYPE_CHECKING

from mesh.errors import ConfigurationError

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from mesh.telemetry.families import Family
    from mesh.telemetry.health import Health
    from mesh.telemetry.server import Answer, Server


def open_server(listen: str, families: Callable[[], Iterable[Family]], health: Callable[[], Health]) -> Server:
    """A server at `listen` (HOST:PORT), to be used with `with`; it calls both on threads of its own.

    Raises `ConfigurationError` for a text that is no HOST:PORT, or without prometheus_client; entering it does so where
    nothing can be served.
    """
    host, port = place(listen)
    try:
        from mesh.telemetry.exposition import Exposition
    except ModuleNotFoundError as error:
        raise ConfigurationError(
            f"metrics need {error.name}, which is not installed",
            hint="pip install 'aira-mesh[metrics]', or leave metrics_listen empty",
        ) from None
    from mesh.telemetry.server import Answer, Server

    exposition = Exposition()

    def metrics(accept: str) -> Answer:
        return Answer(*exposition.render(families(), accept=accept))

    return Server(host, port, metrics=metrics, health=health)


def place(listen: str) -> tuple[str, int]:
    """The host and the port of HOST:PORT; an IPv6 address is in brackets. Raises `ConfigurationError`."""
    host, _, port = listen.rpartition(":")
    bare = host.removeprefix("[").removesuffix("]")
    if not bare or (":" in bare) == (bare == host) or not (port.isascii() and port.isdigit()) or int(port) > 65_535:
        raise ConfigurationError(
            f"{listen!r} is no HOST:PORT to tell metrics at",
            hint="give --metrics-listen 127.0.0.1:9464, or 0.0.0.0:9464 for other machines; empty: nowhere",
        )
    return bare, int(port)
