"""Several routers of one site: linked routers carry one market, and a stranger's router can not link to them."""

from __future__ import annotations

import dataclasses
import time
from dataclasses import replace
from typing import TYPE_CHECKING

import pytest

from mesh.errors import ConfigurationError
from mesh.network import Network
from mesh.ops.identity import Member
from mesh.ops.identity.routers import router_endpoints
from tests.support.ports import free_port
from tests.support.sites import Site
from tests.support.waiting import until

if TYPE_CHECKING:
    from pathlib import Path

    import zenoh

    from mesh.ops.identity.certificates import MemberFolder
    from mesh.settings import Settings

ARM, SCREEN, HUB, SECOND = ("0x" + f"{number:02x}" * 20 for number in (1, 2, 0x99, 3))
KEY = f"aira/agent/{ARM}/device/arm/state"
SECONDS = 60.0
LONG = 1.0
"""Seconds in which a link that carries anything would long have done so."""


@pytest.fixture
def site(tmp_path: Path) -> Site:
    site = Site(tmp_path)
    with site.roster.open("a") as roster:
        roster.write(f'[[member]]\nname = "hub"\naddress = "{HUB}"\nroles = ["router"]\n\n')
    return site


def linked(site: Site, own: MemberFolder, port: int) -> Settings:
    """The settings of a second router, which keeps a link to the site's first."""
    return dataclasses.replace(
        site.settings(),
        listen=(f"tls/127.0.0.1:{port}",),
        link=(site.endpoint,),
        tls_certificate=str(own.certificate),
        tls_key=str(own.key),
    )


async def until_it_arrives(speaker: zenoh.Session, listener: zenoh.Session) -> None:
    """Return when the listener receives messages of the speaker."""
    heard: list[bytes] = []

    def said() -> bool:
        speaker.put(KEY, b"")
        return bool(heard)

    with listener.declare_subscriber(KEY, lambda sample: heard.append(sample.payload.to_bytes())):
        await until(said, seconds=SECONDS)


def member_of_second(site: Site, folder: MemberFolder, port: int) -> Network:
    """A client of the second router."""
    return Network(replace(site.client(folder), connect=(f"tls/127.0.0.1:{port}",)))


@pytest.mark.parametrize("kind", ["wheel", "zenohd"])
async def test_linked_routers_carry_one_market_also_after_one_restarted(site: Site, kind: str) -> None:
    arm = site.enlist(Member(name="arm", address=ARM, roles=("agent",)))
    screen = site.enlist(Member(name="screen", address=SCREEN, roles=("watcher",)))
    second, port = site.enlist(Member(name="second", address=SECOND, roles=("router",))), free_port()
    endpoints = router_endpoints(linked(site, second, port))
    async with Network(endpoints), member_of_second(site, screen, port) as screens:  # before the first is there
        for _ in range(2):
            with site.open_router(kind):
                async with Network(site.client(arm)) as arms:
                    await until_it_arrives(arms.session, screens.session)


async def test_a_router_that_is_not_in_the_roster_links_nothing(site: Site) -> None:
    arm = site.enlist(Member(name="arm", address=ARM, roles=("agent",)))
    screen = site.enlist(Member(name="screen", address=SCREEN, roles=("watcher",)))
    rogue, port = site.certify("rogue", SECOND, "router", hosts=("127.0.0.1",)), free_port()
    with site.open_router("wheel"):
        async with (
            Network(router_endpoints(linked(site, rogue, port))) as rogues,
            Network(site.client(arm)) as arms,
            Network(site.client(screen)) as screens,
        ):
            heard: list[bytes] = []
            await until(lambda: list(rogues.session.info.routers_zid()), seconds=SECONDS)
            ends = time.monotonic() + LONG
            with screens.session.declare_subscriber(KEY, lambda sample: heard.append(sample.payload.to_bytes())):
                while time.monotonic() < ends:
                    rogues.session.put(KEY, b"false")
                    await until_it_arrives(arms.session, screens.session)
            assert b"false" not in heard


def test_a_link_without_a_certificate_is_refused(site: Site) -> None:
    settings = dataclasses.replace(site.settings(), link=("tcp/192.0.2.1:7447",))

    with pytest.raises(ConfigurationError) as without_tls:
        router_endpoints(settings)
    assert "tcp/192.0.2.1:7447" in str(without_tls.value)
    assert "tls/HOST:PORT" in without_tls.value.hint

    with pytest.raises(ConfigurationError) as without_roster:
        router_endpoints(dataclasses.replace(settings, roster="", listen=("tcp/127.0.0.1:1",)))
    assert "tcp/192.0.2.1:7447" in str(without_roster.value)
    assert "--roster" in without_roster.value.hint
