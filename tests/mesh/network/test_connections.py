"""Ending the sessions at a router that a file blocks, while the router and all others go on."""

from __future__ import annotations

import asyncio
from collections import Counter
from contextlib import AsyncExitStack, asynccontextmanager
from typing import TYPE_CHECKING

import pytest

from mesh.base.background import Background
from mesh.base.flood import Drops
from mesh.network import Endpoints, Network
from mesh.network.session import (
    BlockedSessions,
    Connection,
    connections,
    guard,
    parse_session,
    received,
    report_traffic,
)
from mesh.ops.identity import Member
from mesh.ops.identity.routers import router_endpoints
from tests.support.log_events import logged_facts
from tests.support.ports import free_port
from tests.support.sites import Site
from tests.support.waiting import until

if TYPE_CHECKING:
    from collections.abc import AsyncIterator
    from pathlib import Path

ARM, ANN = "0x" + "01" * 20, "0x" + "02" * 20


@asynccontextmanager
async def guarded(router: Network, path: Path, drops: Drops) -> AsyncIterator[None]:
    async with Background() as tasks:
        tasks.start(guard(router.session, BlockedSessions(path), drops), "guard")
        yield


def hear_all(router: Network) -> Counter[str]:
    """Count the payloads that reach the router."""
    heard: Counter[str] = Counter()
    router.session.declare_subscriber("a/b", lambda sample: heard.update([sample.payload.to_string()]))
    return heard


async def says(speaker: Network, heard: Counter[str], word: str) -> None:
    """Return when a word arrives."""
    before = heard[word]
    while heard[word] == before:
        speaker.session.put("a/b", word)
        await asyncio.sleep(0.02)


async def test_a_session_is_ended_and_kept_out_while_its_id_is_in_the_file(tmp_path: Path) -> None:
    path, drops, endpoint = tmp_path / "blocked.txt", Drops(), f"tcp/127.0.0.1:{free_port()}"
    path.touch()
    async with AsyncExitStack() as stack:
        router = await stack.enter_async_context(Network(Endpoints(mode="router", listen=(endpoint,))))
        bad, good = [await stack.enter_async_context(Network(Endpoints(connect=(endpoint,)))) for _ in range(2)]
        heard = hear_all(router)
        await stack.enter_async_context(guarded(router, path, drops))
        async with asyncio.timeout(30):
            await says(bad, heard, "bad")
        path.write_text(f"{bad.id}  # floods\n")
        await until(lambda: drops.totals().get("blocked-session", 0) > 3, what="it connects again and again")
        assert drops.heaviest("blocked-session")[0][0] == "127.0.0.1"
        await says(good, heard, "good")
        assert good.losses == 0
        path.write_text("")
        async with asyncio.timeout(30):
            await says(bad, heard, "bad")


async def test_a_member_is_kept_out_by_the_address_in_its_certificate(tmp_path: Path) -> None:
    site, path, drops = Site(tmp_path), tmp_path / "blocked.txt", Drops()
    arm, ann = (site.enlist(Member(name=name, address=who, roles=("agent",))) for name, who in (("a", ARM), ("b", ANN)))
    path.write_text(ARM)
    async with AsyncExitStack() as stack:
        router = await stack.enter_async_context(Network(router_endpoints(site.settings())))
        await stack.enter_async_context(guarded(router, path, drops))
        await stack.enter_async_context(Network(site.client(ann)))
        opening = asyncio.ensure_future(stack.enter_async_context(Network(site.client(arm))))
        await until(lambda: drops.heaviest("blocked-session"))
        assert {name for name, _ in drops.heaviest("blocked-session")} == {ARM}
        path.write_text("")
        await opening
        await until(lambda: {each.name for each in connections(router.session)} == {ARM, ANN})


@pytest.mark.parametrize(
    ("entry", "is_blocked"),
    [
        ("ab12", True),
        ("AB12", True),
        (ARM, True),
        ("192.0.2.7", True),
        ("192.0.2.0/24", True),
        ("192.0.2.99/24", True),
        ("ab1", False),
        (ANN, False),
        ("192.0.2.8", False),
        ("2001:db8::/32", False),
    ],
)
@pytest.mark.parametrize("host", ["192.0.2.7", "::ffff:192.0.2.7"])
def test_a_session_is_blocked_by_its_id_its_address_or_its_network(
    tmp_path: Path, entry: str, is_blocked: bool, host: str
) -> None:
    path = tmp_path / "blocked.txt"
    path.write_text(entry)
    blocked = BlockedSessions(path)
    assert blocked.changed()
    assert not blocked.changed()
    assert (Connection("ab12", ARM, host, 1) in blocked) == is_blocked


@pytest.mark.parametrize("text", ["somebody", "192.0.2", "0x12", "ab" * 17])
def test_what_names_no_session_is_refused(text: str) -> None:
    with pytest.raises(ValueError):  # noqa: PT011 - of several kinds
        parse_session(text)


async def test_the_heaviest_session_is_reported(caplog: pytest.LogCaptureFixture) -> None:
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    caplog.set_level("INFO", logger="mesh")
    async with AsyncExitStack() as stack:
        router = await stack.enter_async_context(Network(Endpoints(mode="router", listen=(endpoint,))))
        loud, _quiet = [await stack.enter_async_context(Network(Endpoints(connect=(endpoint,)))) for _ in range(2)]
        tasks = await stack.enter_async_context(Background())
        tasks.start(report_traffic(router.session, interval=0.05, least=100_000), "traffic")

        def reported() -> bool:
            loud.session.put("a/b", b"x" * 200_000)  # whose parts may come in several intervals
            return bool(logged_facts(caplog, "traffic-reported"))

        await until(reported, pause=0.1)
        facts = logged_facts(caplog, "traffic-reported")[0]
        assert int(facts["bytes"]) >= 100_000
        assert facts["heaviest"].startswith(loud.id)
        await until(lambda: max(received(connections(router.session)).values()) >= 200_000)
