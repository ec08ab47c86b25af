"""TLS identities: which ones a router accepts, how rejections are reported, and renewed certificates."""

from __future__ import annotations

import asyncio
import json
import os
import shutil
from contextlib import aclosing, closing
from dataclasses import replace
from typing import TYPE_CHECKING

import pytest
import zenoh

from mesh.errors import ConfigurationError, NetworkUnavailable, RemoteError
from mesh.network import Endpoints, Network, NetworkChange, Tls
from mesh.ops.identity import Member
from mesh.ops.identity.certificates import Holder, MemberFolder, SiteFolder
from mesh.ops.identity.routers import router_endpoints
from tests.support.ports import free_port
from tests.support.raising import raises_with
from tests.support.sites import Site
from tests.support.waiting import at_most, until, until_heard

if TYPE_CHECKING:
    from pathlib import Path

ARM = "0x" + "01" * 20
ANN = "0x" + "02" * 20
SECONDS = 60.0


@pytest.fixture
def site(tmp_path: Path) -> Site:
    return Site(tmp_path)


@pytest.fixture
def arm(site: Site) -> MemberFolder:
    return site.enlist(Member(name="arm", address=ARM, roles=("agent",)))


def foreigner(site: Site, address: str) -> MemberFolder:
    """A member of another site whose certificate names one of our addresses."""
    elsewhere = SiteFolder(site.folder / "elsewhere")
    elsewhere.make(name="another site", days=1)
    folder = MemberFolder(site.folder / "foreigner")
    folder.make(Holder(address=address), site=elsewhere, days=1)
    return folder


async def refused(endpoints: Endpoints) -> RemoteError:
    """The error of a client that a router rejects, although it would wait forever for one."""
    with at_most(20), raises_with(RemoteError, code="not-admitted") as error:
        async with Network(replace(endpoints, timeout=-1)):
            pass
    assert "\n" not in str(error.value)
    assert "--tls-ca" in error.value.hint
    return error.value


@pytest.mark.parametrize("kind", ["wheel", "zenohd"])
async def test_a_foreign_identity_is_rejected_at_once(site: Site, arm: MemberFolder, kind: str) -> None:
    other = foreigner(site, ARM)
    with site.open_router(kind):
        async with Network(site.client(arm)) as network:
            assert network.connected

        nobody = Endpoints(connect=(site.endpoint,), tls=Tls(ca=arm.ca))
        assert f"{site.endpoint}: it requires a certificate" in str(await refused(nobody))

        # The foreigner shows its own site's certificate.
        pretended = Tls(ca=other.ca, certificate=other.certificate, key=other.key)
        error = await refused(Endpoints(connect=(site.endpoint,), tls=pretended))
        assert f"{site.endpoint}: its certificate is not trusted" in str(error)

        mixed = Tls(ca=arm.ca, certificate=other.certificate, key=other.key)
        with raises_with(ConfigurationError, code="tls-unusable") as caught:
            async with Network(Endpoints(connect=(site.endpoint,), tls=mixed)):
                pass
        assert "is not from the site" in str(caught.value)


@pytest.mark.parametrize("kind", ["wheel", "zenohd"])
async def test_a_router_rejects_a_certificate_of_another_site_even_if_the_client_trusts_both(
    site: Site, kind: str
) -> None:
    other = foreigner(site, ARM)
    both = site.folder / "both.pem"
    both.write_bytes(site.authority.certificate.read_bytes() + other.ca.read_bytes())
    tls = Tls(ca=both, certificate=other.certificate, key=other.key)

    with site.open_router(kind):
        error = await refused(Endpoints(connect=(site.endpoint,), tls=tls))

    assert f"{site.endpoint}: the certificate is not from its site" in str(error)


@pytest.mark.parametrize("kind", ["wheel", "zenohd"])
async def test_an_expired_certificate_is_reported(site: Site, kind: str) -> None:
    old = site.certify("old", ARM, "agent", days=-0.001)

    with site.open_router(kind), at_most(20), raises_with(ConfigurationError, code="tls-unusable") as error:
        async with Network(site.client(old, timeout=-1)):
            pass

    assert "expired" in str(error.value)
    assert str(old.certificate) in str(error.value)
    assert "aira identity renew" in error.value.hint


@pytest.mark.parametrize("kind", ["wheel", "zenohd"])
async def test_the_router_rejects_foreign_identities_without_the_clients_checks(
    site: Site, arm: MemberFolder, kind: str
) -> None:
    old, other = site.certify("old", ARM, "agent", days=-0.001), foreigner(site, ARM)
    identities = [
        Tls(ca=arm.ca),
        Tls(ca=arm.ca, certificate=old.certificate, key=old.key),
        Tls(ca=arm.ca, certificate=other.certificate, key=other.key),
    ]
    with site.open_router(kind):
        for tls in identities:
            config = zenoh.Config()
            for path, value in Endpoints(connect=(site.endpoint,), tls=tls).options().items():
                config.insert_json5(path, json.dumps(value))
            with pytest.raises(zenoh.ZError):
                await asyncio.to_thread(zenoh.open, config)


async def test_a_router_whose_certificate_names_another_host_is_not_trusted(site: Site, arm: MemberFolder) -> None:
    with site.open_router("wheel"):
        elsewhere = replace(site.client(arm), connect=(f"tls/localhost:{site.port}",))
        error = await refused(elsewhere)

    assert "is not valid for 'localhost'" in str(error)


async def test_a_client_waits_for_a_missing_router_until_its_timeout(site: Site, arm: MemberFolder) -> None:
    with (
        at_most(20),
        pytest.raises(
            NetworkUnavailable,
        ),
    ):
        async with Network(site.client(arm, timeout=0.5)):
            pass


async def test_of_two_routers_the_one_that_accepts_is_used(site: Site, tmp_path: Path) -> None:
    ours = Site(tmp_path / "ours")
    arm = ours.enlist(Member(name="arm", address=ARM, roles=("agent",)))
    with site.open_router("wheel"), ours.open_router("wheel"):
        both = replace(ours.client(arm), connect=(site.endpoint, ours.endpoint))
        async with Network(both) as network:
            assert network.connected


async def test_a_second_router_of_the_site_takes_over(site: Site, arm: MemberFolder) -> None:
    first, second = site.endpoint, f"tls/127.0.0.1:{free_port()}"
    ann = site.enlist(Member(name="ann", address=ANN, roles=("watcher",)))
    endpoints = router_endpoints(site.settings())
    key = f"aira/agent/{ARM}/device/arm/state"
    async with Network(replace(endpoints, listen=(second,))), Network(endpoints) as gone:
        arms = Network(replace(site.client(arm), connect=(first, second)))
        anns = Network(replace(site.client(ann), connect=(first, second)))
        async with arms, anns, aclosing(arms.changes()) as changes:
            change = asyncio.ensure_future(anext(changes))
            await asyncio.sleep(0)
            await gone.__aexit__(None, None, None)
            async with asyncio.timeout(SECONDS):
                assert await change == NetworkChange.LOST
                assert await anext(changes) == NetworkChange.REGAINED
            await heard(anns.session, arms.session, key)


async def heard(listener: zenoh.Session, speaker: zenoh.Session, key: str) -> None:
    """Return when a message on the key has reached the subscriber."""
    heard: list[str] = []
    with listener.declare_subscriber(key, lambda sample: heard.append(str(sample.key_expr))):
        await until_heard(speaker, key)
        speaker.put(key, b"")
        await until(lambda: heard, seconds=SECONDS)


@pytest.mark.parametrize("kind", ["wheel", "zenohd"])
async def test_a_session_outlives_its_certificate_when_that_was_renewed(site: Site, kind: str) -> None:
    site.roster.write_text(site.roster.read_text() + f'[[member]]\nname="arm"\naddress="{ARM}"\nroles=["agent"]\n')
    seconds = 8.0
    key = f"aira/agent/{ARM}/device/arm/state"
    with site.open_router(kind):
        arm = site.certify("arm", ARM, "agent", days=seconds / 86_400)  # it runs from now
        async with Network(site.client(arm)) as network:
            session = network.session
            got: list[str] = []
            with session.declare_subscriber(key, lambda sample: got.append(str(sample.key_expr))):
                async with aclosing(network.changes()) as changes:
                    change = asyncio.ensure_future(anext(changes))
                    await asyncio.sleep(0)
                    arm.renew(site=site.authority, days=1)
                    async with asyncio.timeout(SECONDS):
                        assert await change == NetworkChange.LOST
                        assert await anext(changes) == NetworkChange.REGAINED

                assert network.session is session
                async with Network(site.client(arm)) as second:
                    await until_heard(second.session, key)
                    second.session.put(key, b"")
                    await until(lambda: got, seconds=SECONDS)


async def test_unusable_files_are_reported(site: Site, arm: MemberFolder, tmp_path: Path) -> None:
    ann = site.certify("ann", ANN, "person")
    rubbish = tmp_path / "rubbish"
    rubbish.write_text("rubbish")
    missing = tmp_path / "missing"
    cases = [
        (Tls(ca=missing), "can't read the site's certificate"),
        (Tls(ca=rubbish), "is not a PEM certificate"),
        (Tls(ca=arm.ca, certificate=arm.certificate), "only one of"),
        (Tls(ca=arm.ca, certificate=missing, key=arm.key), "can't read the certificate"),
        (Tls(ca=arm.ca, certificate=arm.certificate, key=missing), "can't read the key"),
        (Tls(ca=arm.ca, certificate=arm.certificate, key=ann.key), "does not belong to"),
        (Tls(ca=arm.ca, certificate=rubbish, key=arm.key), "is not PEM"),
        (None, "needs the site's certificate"),
    ]
    for tls, why in cases:
        with raises_with(ConfigurationError, code="tls-unusable") as error:
            Endpoints(connect=(site.endpoint,), tls=tls).config()
        assert why in str(error.value)
        assert error.value.hint
    with raises_with(ConfigurationError, code="tls-unusable") as error:
        Endpoints(mode="router", listen=(site.endpoint,), tls=Tls(ca=arm.ca)).config()
    assert "a router needs a certificate" in str(error.value)


async def test_a_router_with_a_certificate_of_another_site_does_not_start(site: Site) -> None:
    other = foreigner(site, ARM)
    shutil.copy(site.authority.certificate, site.folder / "ca.pem")
    tls = Tls(ca=site.folder / "ca.pem", certificate=other.certificate, key=other.key)

    with raises_with(ConfigurationError, code="tls-unusable") as error:
        Endpoints(mode="router", listen=(site.endpoint,), tls=tls).config()
    assert "is not from the site" in str(error.value)


async def test_a_client_without_tls_is_rejected(site: Site, arm: MemberFolder) -> None:
    with site.open_router("wheel"), at_most(20), pytest.raises(NetworkUnavailable):
        async with Network(Endpoints(connect=(f"tcp/127.0.0.1:{site.port}",), timeout=0.5)):
            pass


def test_no_file_with_a_key_can_be_read_by_others(site: Site, arm: MemberFolder) -> None:
    umask = os.umask(0)
    try:
        ann = site.certify("ann", ANN, "person")
    finally:
        os.umask(umask)

    assert [path.stat().st_mode & 0o777 for path in (site.authority.key, arm.key, ann.key)] == [0o600] * 3


def test_a_silent_port_shakes_no_hands(site: Site, arm: MemberFolder) -> None:
    import socket

    from mesh.network.tls import shake_hands

    with closing(socket.create_server(("127.0.0.1", site.port))):
        assert shake_hands(site.client(arm).tls or pytest.fail("no identity"), site.endpoint, 0.2) is None
