"""`aira router`: open on this machine only, or closed by a roster that may change while it runs."""

from __future__ import annotations

import asyncio
import json
from contextlib import aclosing
from typing import TYPE_CHECKING

import pytest

from mesh.errors import ConfigurationError
from mesh.network import Network, NetworkChange
from mesh.ops.identity import Member
from tests.support.commands import AIRA, Serving, invoke, refused
from tests.support.ports import free_port
from tests.support.sites import Site, SiteZenohd
from tests.support.waiting import until, until_found, until_heard

if TYPE_CHECKING:
    from pathlib import Path

    from mesh.ops.identity.certificates import MemberFolder

ARM, ANN = "0x" + "01" * 20, "0x" + "02" * 20
SECONDS = 60.0


@pytest.fixture
def site(tmp_path: Path) -> Site:
    return Site(tmp_path)


def options(site: Site) -> tuple[str, ...]:
    settings = site.settings()
    names = ("roster", "tls_ca", "tls_certificate", "tls_key")
    flags = [word for name in names for word in (f"--{name.replace('_', '-')}", getattr(settings, name))]
    return ("--listen", site.endpoint, *flags)


def test_without_a_roster_it_logs_that_only_this_machine_can_connect() -> None:
    says = "no roster: every client on this machine may do everything"
    with Serving(*AIRA, "router", "--listen", f"tcp/127.0.0.1:{free_port()}", says=says) as router:
        assert "listens at tcp/127.0.0.1:" in router.log()


@pytest.mark.parametrize("command", ["router", "up"])
@pytest.mark.parametrize("listen", ["tcp/0.0.0.0:{}", "tcp/[::]:{}", "tcp/example.org:{}", "udp/192.0.2.1:{}"])
def test_without_a_roster_it_listens_on_loopback_only(command: str, listen: str) -> None:
    locator = listen.format(free_port())

    done = invoke(command, "--listen", locator)

    assert "--roster" in refused(done, ConfigurationError, locator)


def test_with_a_roster_it_does_not_listen_without_tls(site: Site) -> None:
    done = invoke("router", "--roster", site.roster, "--listen", "tcp/127.0.0.1:7447")

    assert "tls/HOST:PORT" in refused(done, ConfigurationError, "tcp/127.0.0.1:7447")


def test_with_a_roster_it_needs_a_certificate(site: Site) -> None:
    done = invoke("router", "--roster", site.roster, "--listen", site.endpoint)

    refused(done, ConfigurationError, "certificate")


async def speak(speaker: Network, listener: Network, key: str) -> None:
    """Return when a put of the one has reached the other."""
    heard: list[str] = []
    with listener.session.declare_subscriber(key, lambda sample: heard.append(str(sample.key_expr))):
        await until_heard(speaker.session, key)

        async def is_heard() -> bool:
            speaker.session.put(key, b"")  # again: one that is put while its session is ended is lost
            await asyncio.sleep(0.05)
            return bool(heard)

        await until_found(is_heard, seconds=SECONDS)


async def test_a_revoked_member_is_disconnected_and_the_others_are_not(site: Site) -> None:
    arm = site.enlist(Member(name="arm", address=ARM, roles=("agent",)))
    thief = site.enlist(Member(name="thief", address=ANN, roles=("agent",)))
    screen = site.enlist(Member(name="screen", address="0x" + "03" * 20, roles=("watcher",)))
    key = "aira/agent/{}/device/arm/state"
    with Serving(*AIRA, "router", *options(site), says="roster: 3 members admitted") as router:
        async with network(site, arm) as arms, network(site, thief) as thiefs, network(site, screen) as screens:
            heard: list[str] = []
            hear = screens.session.declare_subscriber("aira/agent/**", lambda one: heard.append(str(one.key_expr)))
            await speak(thiefs, screens, key.format(ANN))
            async with aclosing(screens.changes()) as changes:
                change = asyncio.ensure_future(anext(changes))
                await asyncio.sleep(0)
                revoke(site, "thief")
                async with asyncio.timeout(SECONDS):
                    assert await change == NetworkChange.LOST
                    assert await anext(changes) == NetworkChange.REGAINED
            await until(lambda: "roster: 2 members admitted" in router.log(), seconds=SECONDS)

            await until(lambda: thiefs.connected and arms.connected, seconds=SECONDS)
            heard.clear()
            thiefs.session.put(key.format(ANN), b"")
            list(thiefs.session.get("aira/nobody"))  # the router has taken what came before
            await speak(arms, screens, key.format(ARM))
            assert set(heard) == {key.format(ARM)}
            hear.undeclare()  # type: ignore[no-untyped-call]


async def test_a_blocked_session_is_ended_without_a_restart(site: Site, tmp_path: Path) -> None:
    arm = site.enlist(Member(name="arm", address=ARM, roles=("agent",)))
    screen = site.enlist(Member(name="screen", address=ANN, roles=("watcher",)))
    blocked = tmp_path / "blocked.txt"
    blocked.touch()
    with Serving(*AIRA, "router", *options(site), "--blocked-sessions", blocked, says="2 members admitted") as router:
        async with network(site, arm) as arms, network(site, screen) as screens:
            blocked.write_text(ARM)
            await until(lambda: arms.losses, seconds=SECONDS)
            blocked.write_text("")
            await speak(arms, screens, f"aira/agent/{ARM}/device/arm/state")
            assert screens.losses == 0
        assert "restarting the router" not in router.log()


async def test_a_roster_that_becomes_invalid_changes_nothing(site: Site) -> None:
    arm = site.enlist(Member(name="arm", address=ARM, roles=("agent",)))
    good = site.roster.read_text()
    with Serving(*AIRA, "router", *options(site), says="roster: 1 member admitted") as router:
        async with network(site, arm) as arms, aclosing(arms.changes()) as changes:
            change = asyncio.ensure_future(anext(changes))
            put_roster(site, "[[member]]\nname=")
            await until(lambda: "the router keeps its previous roster" in router.log(), seconds=SECONDS)
            put_roster(site, good)
            await until(lambda: "the roster is valid again" in router.log(), seconds=SECONDS)
            assert not change.done()
            change.cancel()
            with pytest.raises(asyncio.CancelledError):
                await change
        assert router.log().count("the router keeps its previous roster") == 1
        assert "Traceback" not in router.log()


def network(site: Site, folder: MemberFolder) -> Network:
    return Network(site.client(folder))


def revoke(site: Site, name: str) -> None:
    text = site.roster.read_text()
    put_roster(site, text.replace(f'name = "{name}"', f'name = "{name}"\nrevoked = true'))


def put_roster(site: Site, text: str) -> None:
    """Replace the roster at once: a router that reads it meanwhile sees no half of it."""
    fresh = site.roster.with_suffix(".fresh")
    fresh.write_text(text)
    fresh.replace(site.roster)


def test_acl_lists_the_rights_of_each_member_and_none_of_revoked_ones(site: Site) -> None:
    site.enlist(Member(name="arm", address=ARM, roles=("agent",)))
    site.enlist(Member(name="gone", address=ANN, roles=("agent",), revoked=True))

    table = invoke("router", "acl", "--check", "--roster", site.roster)
    found = json.loads(invoke("router", "acl", "--check", "--json", "--roster", site.roster).stdout)
    rules = json.loads(invoke("router", "acl", "--roster", site.roster).stdout)

    assert table.returncode == 0
    rows = [line.split() for line in table.stdout.splitlines()]
    assert rows[0] == ["NAME", "ADDRESS", "ROLES", "MAY", "KEYS"]
    assert ["arm", ARM, "agent", "delete", f"aira/agent/{ARM}/**"] in rows
    assert ["gone", ANN, "agent", "nothing", "(revoked)"] in rows
    assert [one["name"] for one in found] == ["arm", "gone"]
    assert found[0]["may"]["delete"] == [f"aira/agent/{ARM}/**"]
    assert found[1] == {"name": "gone", "address": ANN, "roles": ["agent"], "revoked": True, "may": {}}
    assert rules["default_permission"] == "deny"
    assert [subject["id"] for subject in rules["subjects"]] == [ARM]


async def test_config_configures_zenohd_as_the_same_router(site: Site, tmp_path: Path) -> None:
    arm = site.enlist(Member(name="arm", address=ARM, roles=("agent",)))
    screen = site.enlist(Member(name="screen", address=ANN, roles=("watcher",)))
    file = tmp_path / "zenohd.json5"

    done = invoke("router", *options(site), "config", "--out", file)

    assert (done.returncode, done.stdout) == (0, f"zenohd --config {file}\n")
    with SiteZenohd(site.port, file.read_text()):
        async with network(site, arm) as arms, network(site, screen) as screens:
            await speak(arms, screens, f"aira/agent/{ARM}/device/arm/state")


def test_config_refuses_settings_that_can_not_work(site: Site, tmp_path: Path) -> None:
    site.roster.write_text('[[member]]\nname="x"\naddress="0x12"\nroles=["agent"]\n')

    done = invoke("router", *options(site), "config", "--out", tmp_path / "zenohd.json5")

    refused(done, "roster-unusable", "'0x12'")
    assert not (tmp_path / "zenohd.json5").exists()
