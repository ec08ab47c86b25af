"""The outbox: what must arrive is sent until it has."""

from __future__ import annotations

import asyncio
from contextlib import asynccontextmanager, suppress
from typing import TYPE_CHECKING, Any

import pytest

from mesh.background import Background
from mesh.network import Channel, Endpoints, Network
from mesh.work import Ledger
from mesh.work import outbox as outbox_module
from mesh.work.outbox import Outbox, outgoing, outgoing_identity
from schemas import decode, encode, message_hash
from tests.support.orders import LIGHTHOUSE, MARKET, demand, offer, result
from tests.support.waiting import until, until_found, until_heard

if TYPE_CHECKING:
    from collections.abc import AsyncIterator
    from pathlib import Path

    from tests.support.routers import EmbeddedRouter

QUICKLY = 0.05


class Post:
    """An outbox on a network of its own, and the chain's head as it knows it."""

    def __init__(self, ledger: Ledger, channel: Channel, network: Network) -> None:
        self.head = 0
        self.ledger = ledger
        self.network = network
        self.outbox = Outbox(ledger, channel, network, head=lambda: self.head)


@pytest.fixture(autouse=True)
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(outbox_module, "RESEND", QUICKLY)


@asynccontextmanager
async def opened(router: EmbeddedRouter, folder: Path) -> AsyncIterator[Post]:
    async with (
        Network(Endpoints(connect=(router.endpoint,))) as network,
        Channel(network.session, MARKET) as channel,
        Ledger(folder / "ledger.sqlite") as ledger,
    ):
        yield Post(ledger, channel, network)


@pytest.fixture
async def post(router: EmbeddedRouter, tmp_path: Path) -> AsyncIterator[Post]:
    async with opened(router, tmp_path) as post:
        yield post


@pytest.fixture
async def heard(router: EmbeddedRouter) -> AsyncIterator[list[tuple[str, Any]]]:
    """What somebody else hears on the market: key and message."""
    arrived: list[tuple[str, Any]] = []
    async with Network(Endpoints(connect=(router.endpoint,))) as network:
        network.session.declare_subscriber(
            f"aira/{MARKET}/**",
            lambda sample: arrived.append((str(sample.key_expr), decode(sample.payload.to_bytes()))),
        )
        yield arrived


async def listened_to(post: Post) -> None:
    await until_heard(post.network.session, f"aira/{MARKET}/x")


async def test_what_is_posted_is_sent_at_once_on_its_key(post: Post, heard: list[tuple[str, Any]]) -> None:
    await listened_to(post)
    ours = offer()
    await post.outbox.post(ours)
    await until(lambda: heard)
    digest = message_hash(ours).hex()
    assert heard == [(f"aira/{MARKET}/offer/{ours.model}/{digest}", ours)]


async def test_what_has_no_effect_is_sent_again_and_what_has_is_not(post: Post, heard: list[tuple[str, Any]]) -> None:
    await listened_to(post)
    first, second = demand(), result()
    async with Background() as tasks:
        tasks.start(post.outbox.run(), "outbox")
        await post.outbox.post(first)
        await post.outbox.post(second)
        await until(lambda: [message for _, message in heard].count(second) >= 3)
        assert await post.outbox.settle(outgoing_identity(second))
        assert not await post.outbox.settle(outgoing_identity(second))
        await asyncio.sleep(QUICKLY)
        so_far = [message for _, message in heard].count(second)
        before = [message for _, message in heard].count(first)
        await until(lambda: [message for _, message in heard].count(first) >= before + 3)
        assert [message for _, message in heard].count(second) == so_far


async def test_an_order_is_forgotten_at_its_deadline_and_a_result_never(post: Post) -> None:
    await post.outbox.post(demand(deadline=10))
    await post.outbox.post(result())
    post.head = 9
    await post.outbox.send()
    assert len(await post.ledger.outbox(head=0)) == 2
    post.head = 10
    await post.outbox.send()
    assert [waiting.kind for waiting in await post.ledger.outbox(head=0)] == ["result"]


async def test_what_waits_survives_a_restart(
    router: EmbeddedRouter, tmp_path: Path, heard: list[tuple[str, Any]]
) -> None:
    ours = result()
    async with opened(router, tmp_path) as post:
        await post.ledger.post(outgoing(ours))  # and then, before it was sent, a crash
    async with opened(router, tmp_path) as post:
        await listened_to(post)
        await post.outbox.send()
        await until(lambda: heard)
    assert heard[0][1] == ours


async def test_it_is_sent_at_once_when_the_network_comes_back(
    router: EmbeddedRouter, post: Post, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(outbox_module, "RESEND", 3600.0)
    ours, arrived = demand(), [b""]

    async def comes_back() -> bool:
        """The client may be quicker than the subscriber of who looks on; then nobody is there to see it."""
        await asyncio.to_thread(router.stop)
        await until(lambda: not post.network.connected)
        await post.outbox.post(ours)
        await asyncio.to_thread(router.start)
        assert router._session is not None
        router._session.declare_subscriber("aira/**", lambda sample: arrived.append(sample.payload.to_bytes()))
        await until(lambda: post.network.connected)
        with suppress(AssertionError):
            await until(lambda: encode(ours) in arrived, seconds=2)
        return encode(ours) in arrived

    async with Background() as tasks:
        tasks.start(post.outbox.run(), "outbox")
        await until_found(comes_back, seconds=60)


def test_a_result_is_known_by_its_liability_and_an_order_by_its_hash() -> None:
    assert outgoing_identity(result(success=True)) == outgoing_identity(result(success=False)) == f"result {LIGHTHOUSE}"
    one, other = demand(), demand()
    assert outgoing_identity(one) == message_hash(one).hex() != outgoing_identity(other)


def test_an_entry_says_what_is_sent_and_until_when() -> None:
    order = demand(deadline=77)
    assert (outgoing(order).kind, outgoing(order).deadline) == ("demand", 77)
    assert (outgoing(result()).kind, outgoing(result()).deadline) == ("result", None)
    assert decode(outgoing(order).payload) == order
