"""Identities at a closed site, sound and not: certificates, rosters, and what a member may write."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

import pytest

from mesh.ops.doctor import CheckStatus, DoctorContext
from mesh.ops.identity import Member
from mesh.settings import Settings
from tests.support.doctor.examining import context_of_member, examined, settings_of
from tests.support.sites import MARKET, Site
from tests.support.waiting import at_most

if TYPE_CHECKING:
    from mesh.ops.identity.roster import Role

ARM = "0x" + "0a" * 20
AGENT = "0x" + "0b" * 20
ROUTERS = pytest.mark.parametrize("kind", ["wheel", "zenohd"])


@ROUTERS
async def test_a_member_of_a_site_is_admitted_and_denied_forbidden_writes(site: Site, kind: str) -> None:
    arm = site.enlist(Member(name="arm-1", address=ARM, roles=("agent",)))
    with site.open_router(kind):
        found = await examined(context_of_member(site, arm))

    assert found.failed == []
    assert list(found) == ["certificate", "router", "session", "own write", "denied write", "router clock"]
    assert "arm-1, agent" in found.one("certificate").message
    assert [found.one(name).code for name in ("own write", "router clock")] == ["ok"] * 2
    assert found.one("denied write").code == "denied"
    assert MARKET in found.one("denied write").message


@pytest.mark.sample("role")
@pytest.mark.parametrize("role", ["agent", "person", "provider", "operator", "bridge", "watcher"])
async def test_every_role_passes_with_its_rights(site: Site, role: Role) -> None:
    folder = site.enlist(Member(name="somebody", address=ARM, roles=(role,)))
    with site.open_router("wheel"):
        found = await examined(context_of_member(site, folder))

    assert found.failed == []
    assert found.one("denied write").code == "denied"
    assert ("another agent's keys" in found.one("denied write").message) is (role in ("operator", "watcher"))


async def test_an_edge_agent_is_checked_with_the_device_that_it_serves(site: Site) -> None:
    folder = site.enlist(Member(name="board", address=ARM, roles=("edge",), agent=AGENT, device="lamp"))
    settings = settings_of(site.client(folder))
    with site.open_router("wheel"):
        named = await examined(DoctorContext(settings=settings, requested_role="operator", agent=AGENT, device="lamp"))
        unnamed = await examined(DoctorContext(settings=settings, requested_role="edge"))

    assert named.failed == []
    assert named.one("denied write").code == "denied"
    assert "its agent's jobs" in named.one("denied write").message
    assert "own write" in unnamed.failed


async def test_an_edge_agent_s_own_device_need_not_be_named(site: Site) -> None:
    folder = site.enlist(Member(name="board", address=ARM, roles=("edge",)))
    with site.open_router("wheel"):
        found = await examined(DoctorContext(settings=settings_of(site.client(folder))))

    assert found.failed == ["serial port"]
    assert found.one("denied write").code == "denied"
    assert "its agent's jobs" in found.one("denied write").message


async def test_an_expired_certificate_is_named_and_the_router_is_not_blamed(site: Site) -> None:
    arm = site.certify("arm", ARM, "agent", days=1e-9)
    with site.open_router("wheel"):
        found = await examined(context_of_member(site, arm))

    cause = found.cause("certificate")
    assert cause.code == "tls-unusable"
    assert "`aira identity renew`" in cause.hint
    assert list(found) == ["certificate"]


async def test_a_certificate_that_ends_soon_is_a_warning_with_its_end(site: Site) -> None:
    arm = site.enlist(Member(name="arm", address=ARM, roles=("agent",)))
    with site.open_router("wheel"):
        found = await examined(context_of_member(site, arm))

    result = found.one("certificate")
    assert (result.status, result.code) == (CheckStatus.WARN, "certificate-expires")
    assert time.strftime("%Y-%m-", time.gmtime(time.time() + 86_400)) in result.message
    assert "aira identity renew" in result.hint


@ROUTERS
@pytest.mark.parametrize("revoked", [False, True], ids=["not in the roster", "revoked"])
async def test_an_identity_without_rights_fails(site: Site, kind: str, revoked: bool) -> None:
    site.enlist(Member(name="other", address=AGENT, roles=("agent",)))
    if revoked:
        arm = site.enlist(Member(name="arm", address=ARM, roles=("agent",), revoked=True))
    else:
        arm = site.certify("arm", ARM, "agent")
    with site.open_router(kind):
        found = await examined(context_of_member(site, arm))

    cause = found.cause("own write")
    assert cause.code == "identity-denied"


async def test_a_market_that_the_site_does_not_carry_is_named(site: Site) -> None:
    arm = site.enlist(Member(name="arm", address=ARM, roles=("agent",)))
    with site.open_router("wheel"):
        found = await examined(context_of_member(site, arm, lighthouse_contract="other.lighthouse.3.robonomics.eth"))

    cause = found.cause("denied write")
    assert cause.code == "market-denied"
    assert "other.lighthouse.3.robonomics.eth" in cause.message


async def test_a_certificate_without_its_authority_is_a_failed_check(site: Site) -> None:
    arm = site.certify("arm", ARM, "agent")
    settings = Settings(connect=(site.endpoint,), tls_certificate=str(arm.certificate), tls_key=str(arm.key))

    found = await examined(DoctorContext(settings=settings, requested_role="operator"))

    assert found.cause("certificate").code == "tls-unusable"


async def test_a_router_is_checked_for_its_roster_and_listen_addresses(site: Site) -> None:
    site.enlist(Member(name="arm", address=ARM, roles=("agent",)))
    context = DoctorContext(settings=site.settings())
    idle = await examined(context)
    with site.open_router("wheel"):
        running = await examined(context)

    assert context.role == "router"
    assert idle.cause("router").code == "no-router"
    assert "1 member" in idle.one("roster").message
    assert running.failed == []
    assert list(running) == ["roster", "descriptors", "certificate", "router", "session"]


async def test_an_unreadable_roster_is_named(site: Site) -> None:
    site.roster.write_text("[[member]]\nname = 1\n")
    with at_most(30):
        found = await examined(DoctorContext(settings=site.settings()))

    assert "roster" in found.failed
    assert str(site.roster) in found.one("roster").message
