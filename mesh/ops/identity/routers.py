"""A site's router: its configuration from settings and roster, and whether it admits an identity."""

from __future__ import annotations

import asyncio
import json
import re
from contextlib import ExitStack
from dataclasses import replace
from ipaddress import ip_address
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from mesh.base.background import call_in_loop
from mesh.errors import ConfigurationError, RemoteError
from mesh.network import Network, Tls
from mesh.network.endpoints import Endpoints
from mesh.network.locators import check_locators
from mesh.ops.identity.roster import access_control, read_roster
from schemas.keys import DeviceTopicKey

if TYPE_CHECKING:
    from collections.abc import Mapping

    import zenoh

    from mesh.settings import Settings

HOST: Final = re.compile(r"\w+/(?:\[(?P<six>[^\]]+)\]|(?P<host>[^:]*)):")
LOCAL: Final = ("unixsock-stream/", "unixpipe/")
"""Prefixes of locators that only this machine can reach."""


def router_endpoints(settings: Settings) -> Endpoints:
    """The endpoints of a site's router: addresses, certificate, access rules.

    With a roster it listens on `tls/` only and admits certificates of the site. Without one it listens on loopback
    only. Raises `ConfigurationError`.
    """
    if not settings.roster:
        check_loopback((*settings.listen, *settings.link))
        return _endpoints(settings, Tls.from_settings(settings))
    roster = read_roster(Path(settings.roster).expanduser())
    for locator in (*settings.listen, *settings.link):
        if not locator.startswith("tls/"):
            raise ConfigurationError(
                f"with a roster, {locator} can't be used: it does not authenticate clients", hint="use tls/HOST:PORT"
            )
    tls = Tls.from_settings(settings)
    if tls is None:
        raise ConfigurationError(
            "a router with a roster needs the site's certificate, its own certificate and its key",
            hint="give --tls-ca, --tls-certificate and --tls-key; `aira identity new --role router` creates them",
        )
    return replace(_endpoints(settings, tls), access=access_control(roster))


def _endpoints(settings: Settings, tls: Tls | None) -> Endpoints:
    return Endpoints(
        mode="router",
        listen=settings.listen,
        connect=settings.link,
        tls=tls,
        max_sessions=settings.max_sessions,
        shared_memory=settings.shared_memory,
    )


def check_loopback(listen: tuple[str, ...]) -> None:
    """Raise `ConfigurationError` for a malformed locator, and for one that other machines can reach."""
    check_locators(*listen)
    for locator in listen:
        if not is_loopback(locator):
            raise ConfigurationError(
                f"without a roster a router may listen on loopback only, but other machines can reach {locator}",
                hint="listen on tcp/127.0.0.1:7447, or give --roster; `aira identity new --roster FILE` creates one",
            )


def is_loopback(locator: str) -> bool:
    """Whether only this machine can reach a locator."""
    if locator.startswith(LOCAL):
        return True
    place = HOST.match(locator)
    host = (place["six"] or place["host"]) if place is not None else ""
    if host == "localhost":
        return True
    try:
        return ip_address(host).is_loopback
    except ValueError:
        return False


def zenohd_configuration(endpoints: Endpoints) -> str:
    """The router as a configuration file (JSON5) of `zenohd`. Raises `ConfigurationError` if it can't work."""
    endpoints.config()
    heading = "// Created by `aira router config`; zenohd reads it when it starts: zenohd --config FILE\n"
    return heading + json.dumps(nested(endpoints.options()), indent=2) + "\n"


def nested(options: Mapping[str, object]) -> dict[str, Any]:
    """Options by their path in Zenoh's configuration, as the sections of a file."""
    sections: dict[str, Any] = {}
    for path, value in options.items():
        *names, last = path.split("/")
        section = sections
        for name in names:
            section = section.setdefault(name, {})
        section[last] = value
    return sections


def identity_denied(address: str) -> RemoteError:
    """The error of a router that accepts this identity's certificate but denies all its operations."""
    return RemoteError(
        f"the router accepts {address} but denies all its operations: it is not in the roster, or revoked",
        hint="ask the site's operator; `aira router acl --check --roster FILE` lists the rights of each member",
        code="identity-denied",
    )


async def check_admission(endpoints: Endpoints, address: str, *, agent: str = "", device: str = "") -> None:
    """Return when the router has admitted this identity and forwards its messages.

    A router does not report a denial, so this subscribes to a key below the own address, which every role but `edge`
    may do; an edge agent subscribes below the device `device` of the agent at `agent`. Raises `RemoteError`,
    `InvalidKey`.
    """
    keys = [str(DeviceTopicKey(address, "check", "/check"))]
    if agent:
        keys.append(str(DeviceTopicKey(agent, device, "/check")))
    async with Network(endpoints) as reader, Network(endpoints) as writer:
        with ExitStack() as declared:
            admitted, loop = asyncio.Event(), asyncio.get_running_loop()

            def changed(status: zenoh.MatchingStatus) -> None:
                if status.matching:
                    call_in_loop(loop, admitted.set)

            for key in keys:
                publisher = declared.enter_context(writer.session.declare_publisher(key))
                publisher.declare_matching_listener(changed)
                declared.enter_context(reader.session.declare_subscriber(key, lambda sample: None))
            try:
                async with asyncio.timeout(5):  # by then a router has forwarded what it allows
                    await admitted.wait()
            except TimeoutError:
                raise identity_denied(address) from None
