"""A router that listens on every address of its machine, which no name in its certificate covers."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import pytest
import zenoh

from mesh.ops.doctor import DoctorContext
from mesh.ops.identity import Member
from mesh.ops.identity.routers import router_endpoints
from mesh.settings import Settings
from tests.support.doctor.examining import examined
from tests.support.sites import Site

if TYPE_CHECKING:
    from pathlib import Path

    from mesh.ops.doctor.checks import Role

HOSTS = pytest.mark.parametrize("hosts", [("127.0.0.1",), ("router.site.example",)])


def settings_everywhere(site: Site, hosts: tuple[str, ...]) -> Settings:
    """Those of a router that others know by `hosts`, and that listens on every address."""
    site.enlist(Member(name="arm", address="0x" + "0a" * 20, roles=("agent",)))
    router = site.certify("everywhere", "0x" + "98" * 20, "router", hosts=hosts)
    listen = (f"tls/0.0.0.0:{site.port}",)
    return replace(site.settings(), listen=listen, tls_certificate=str(router.certificate), tls_key=str(router.key))


@HOSTS
async def test_a_router_on_every_address_passes(site: Site, hosts: tuple[str, ...]) -> None:
    settings = settings_everywhere(site, hosts)
    session = zenoh.open(router_endpoints(settings).config())
    try:
        found = await examined(DoctorContext(settings=settings))
    finally:
        session.close()  # type: ignore[no-untyped-call]

    assert found.failed == [], dict(found)
    assert "everywhere" in found.one("router").message


async def test_a_router_of_a_foreign_site_on_every_address_is_named(site: Site, tmp_path: Path) -> None:
    (tmp_path / "other").mkdir()
    other = Site(tmp_path / "other")
    settings = settings_everywhere(site, ("127.0.0.1",))
    foreign = replace(settings_everywhere(other, ("127.0.0.1",)), listen=settings.listen)
    session = zenoh.open(router_endpoints(foreign).config())
    try:
        found = await examined(DoctorContext(settings=settings))
    finally:
        session.close()  # type: ignore[no-untyped-call]

    assert found.cause("router").code == "untrusted"


@pytest.mark.parametrize(("role", "option"), [("operator", "--connect"), ("edge", "--connect"), ("router", "--listen")])
async def test_settings_without_a_router_are_named(role: Role, option: str) -> None:
    found = await examined(DoctorContext(settings=Settings(connect=(), listen=()), requested_role=role))

    result = found.one("router")
    assert (result.ok, result.code) == (False, "router-missing")
    assert option in result.hint
