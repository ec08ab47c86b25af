"""Routers that pass, that are down, of a foreign site, or open to everybody."""

from __future__ import annotations

import dataclasses
import http.server
import socket
import threading
from typing import TYPE_CHECKING

import pytest
import zenoh

from mesh.network import Endpoints, Tls
from mesh.ops.doctor import CheckStatus, DoctorContext
from mesh.ops.identity import Member
from mesh.ops.identity.routers import zenohd_configuration
from mesh.settings import Settings
from tests.support.doctor.examining import context_of_member, examined, settings_of
from tests.support.ports import free_port
from tests.support.sites import Site, SiteZenohd
from tests.support.waiting import at_most

if TYPE_CHECKING:
    from collections.abc import Iterator
    from contextlib import AbstractContextManager
    from pathlib import Path

    from tests.support.routers import EmbeddedRouter, Zenohd

ARM = "0x" + "0a" * 20
ROUTERS = pytest.mark.parametrize("kind", ["wheel", "zenohd"])


async def test_an_open_router_on_loopback_passes(router: EmbeddedRouter) -> None:
    found = await examined(DoctorContext(settings=Settings(connect=(router.endpoint,)), requested_role="operator"))

    assert found.failed == []
    assert (found.one("denied write").status, found.one("denied write").code) == (CheckStatus.OK, "router-open")


async def test_zenohd_passes(zenohd: Zenohd) -> None:
    found = await examined(DoctorContext(settings=Settings(connect=(zenohd.endpoint,)), requested_role="operator"))

    assert found.failed == []


async def test_an_unreachable_router_is_reported_once_with_a_hint() -> None:
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    with at_most(20):
        found = await examined(DoctorContext(settings=Settings(connect=(endpoint,)), requested_role="operator"))

    cause = found.cause("router")
    assert cause.code == "no-router"
    assert endpoint in cause.message
    assert "`aira router`" in cause.hint
    assert list(found) == ["router"]


async def test_one_unreachable_router_of_two_is_reported(router: EmbeddedRouter) -> None:
    dead = f"tcp/127.0.0.1:{free_port()}"
    found = await examined(DoctorContext(settings=Settings(connect=(dead, router.endpoint)), requested_role="operator"))

    assert dead in found.cause("router").message
    assert found.one("own write").ok


async def test_an_unknown_host_name_is_reported() -> None:
    found = await examined(
        DoctorContext(settings=Settings(connect=("tcp/no-such-host.invalid:7447",)), requested_role="operator")
    )

    assert found.cause("router").code == "unresolvable"
    assert "no-such-host.invalid" in found.cause("router").message


@pytest.fixture
def other_server() -> Iterator[str]:
    """A server that is none of Zenoh's."""
    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), http.server.BaseHTTPRequestHandler)
    thread = threading.Thread(target=server.serve_forever)
    thread.start()
    try:
        yield f"tcp/127.0.0.1:{server.server_address[1]}"
    finally:
        server.shutdown()
        thread.join()
        server.server_close()


async def test_a_server_that_is_no_router_fails_the_session_check(other_server: str) -> None:
    found = await examined(DoctorContext(settings=Settings(connect=(other_server,)), requested_role="operator"))

    assert found.cause("session").code == "network-unavailable"


@ROUTERS
async def test_the_router_of_a_foreign_site_is_named(site: Site, tmp_path: Path, kind: str) -> None:
    (tmp_path / "other").mkdir()
    ours = Site(tmp_path / "other").certify("arm", ARM, "agent")
    with site.open_router(kind):
        found = await examined(context_of_member(site, ours))

    cause = found.cause("router")
    assert cause.code == "untrusted"
    assert str(ours.ca) in cause.hint


def open_router(site: Site, kind: str) -> AbstractContextManager[object]:
    """The site's router without its roster: it wants certificates and forbids nothing."""
    tls = Tls(ca=site.router.ca, certificate=site.router.certificate, key=site.router.key)
    endpoints = Endpoints(mode="router", listen=(site.endpoint,), tls=tls)
    if kind == "wheel":
        return zenoh.open(endpoints.config())
    return SiteZenohd(site.port, zenohd_configuration(endpoints))


@ROUTERS
async def test_a_router_that_forwards_denied_writes_fails(site: Site, kind: str) -> None:
    arm = site.enlist(Member(name="arm", address=ARM, roles=("agent",)))
    with open_router(site, kind):
        found = await examined(context_of_member(site, arm))

    cause = found.cause("denied write")
    assert cause.code == "router-open"
    assert "--roster FILE" in cause.hint


@pytest.fixture
def leaky(site: Site) -> Iterator[str]:
    """A second router of the site, which forbids nothing."""
    tls = Tls(ca=site.router.ca, certificate=site.router.certificate, key=site.router.key)
    endpoint = f"tls/127.0.0.1:{free_port()}"
    with zenoh.open(Endpoints(mode="router", listen=(endpoint,), tls=tls).config()):
        yield endpoint


async def test_each_router_of_a_site_is_checked_and_an_open_one_is_named(site: Site, leaky: str) -> None:
    arm = site.enlist(Member(name="arm", address=ARM, roles=("agent",)))
    settings = dataclasses.replace(settings_of(site.client(arm)), connect=(site.endpoint, leaky))
    with site.open_router("wheel"):
        found = await examined(DoctorContext(settings=settings, requested_role="operator"))

    assert found.cause("denied write").code == "router-open"
    assert found.cause("denied write").message.startswith(f"{leaky}: ")
    assert found["denied write"][0].code == "denied"
    assert found["denied write"][0].message.startswith(f"{site.endpoint}: ")


async def test_a_router_open_to_other_machines_is_a_failure() -> None:
    host = own_address()
    endpoint = f"tcp/{host}:{free_port()}"
    with zenoh.open(Endpoints(mode="router", listen=(endpoint,)).config()):
        found = await examined(DoctorContext(settings=Settings(connect=(endpoint,)), requested_role="operator"))

    cause = found.cause("denied write")
    assert cause.code == "router-open"
    assert "aira identity site" in cause.hint


def own_address() -> str:
    """An address of this machine that others reach, without sending anything."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.connect(("192.0.2.1", 9))
        except OSError:
            pytest.skip("this machine has no address but loopback")
        return str(probe.getsockname()[0])
