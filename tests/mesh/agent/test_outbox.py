"""The outbox: what must arrive is sent until it has."""

from __future__ import annotations

import asyncio
import time
from contextlib import asynccontextmanager, suppress
from typing import TYPE_CHECKING, Any

import pytest

from mesh.agent.ledger import Ledger, Outbox, Outgoing, outgoing_identity
from mesh.base.background import Background
from mesh.base.retry import RetryPolicy
from mesh.network import Channel, Endpoints, Network
from schemas import decode, encode, message_hash
from tests.support.orders import LIGHTHOUSE, MARKET, demand, offer, result
from tests.support.waiting import until, until_found, until_heard

if TYPE_CHECKING:
    from collections.abc import AsyncIterator
    from pathlib import Path

    from schemas import Demand, Offer, Result
    from tests.support.routers import EmbeddedRouter

QUICKLY = RetryPolicy(initial=0.05, ceiling=0.05, jitter=0)
NEVER = RetryPolicy(initial=3600.0, ceiling=3600.0)


class Post:
    """An outbox with its own network; the test sets the chain's head and the time."""

    def __init__(self, ledger: Ledger, channel: Channel, network: Network, policy: RetryPolicy) -> None:
        self.head = 0
        self.time = 0.0
        self.ledger = ledger
        self.network = network
        clock = time.monotonic if policy is QUICKLY else lambda: self.time
        self.rounds = 0
        self.outbox = Outbox(
            ledger, channel, network, head=self._read_head, policy=policy, clock=clock, chance=lambda: 0.0
        )

    def _read_head(self) -> int:
        """The head, which the outbox reads a few times each time it looks for messages to send."""
        self.rounds += 1
        assert self.rounds < 10_000, "the outbox looks without a pause"
        return self.head


@asynccontextmanager
async def opened(router: EmbeddedRouter, folder: Path, policy: RetryPolicy = QUICKLY) -> AsyncIterator[Post]:
    async with (
        Network(Endpoints(connect=(router.endpoint,))) as network,
        Channel(network.session, MARKET) as channel,
        Ledger(folder / "ledger.sqlite") as ledger,
    ):
        yield Post(ledger, channel, network, policy)


@pytest.fixture
async def post(router: EmbeddedRouter, tmp_path: Path) -> AsyncIterator[Post]:
    async with opened(router, tmp_path) as post:
        yield post


@pytest.fixture
async def received(router: EmbeddedRouter) -> AsyncIterator[list[tuple[str, Any]]]:
    """The messages that another session receives on the market: key and message."""
    messages: list[tuple[str, Any]] = []
    async with Network(Endpoints(connect=(router.endpoint,))) as network:
        network.session.declare_subscriber(
            f"aira/{MARKET}/**",
            lambda sample: messages.append((str(sample.key_expr), decode(sample.payload.to_bytes()))),
        )
        yield messages


async def listened_to(post: Post) -> None:
    await until_heard(post.network.session, f"aira/{MARKET}/x")


async def test_a_posted_message_is_sent_at_once_on_its_key(post: Post, received: list[tuple[str, Any]]) -> None:
    await listened_to(post)
    ours = offer()
    await post.outbox.post(ours)
    await until(lambda: received)
    assert received == [(f"aira/{MARKET}/offer/{ours.model}", ours)]


async def test_messages_are_sent_again_until_they_have_an_effect(post: Post, received: list[tuple[str, Any]]) -> None:
    await listened_to(post)
    first, second = demand(), result()
    async with Background() as tasks:
        tasks.start(post.outbox.run(), "outbox")
        await post.outbox.post(first)
        await post.outbox.post(second)
        await until(lambda: [message for _, message in received].count(second) >= 3)
        assert await post.outbox.settle(outgoing_identity(second))
        assert not await post.outbox.settle(outgoing_identity(second))

        async def is_sent_twice_more() -> None:
            before = [message for _, message in received].count(first)
            await until(lambda: [message for _, message in received].count(first) >= before + 2)

        await is_sent_twice_more()  # after what was under way
        so_far = [message for _, message in received].count(second)
        await is_sent_twice_more()
        assert [message for _, message in received].count(second) == so_far


async def test_an_order_is_forgotten_at_its_deadline_and_a_result_never(post: Post) -> None:
    await post.outbox.post(demand(deadline=10))
    await post.outbox.post(result())
    post.head = 9
    await post.outbox.send_all()
    assert len(await post.ledger.outbox(head=0)) == 2
    post.head = 10
    await post.outbox.send_all()
    assert [waiting.kind for waiting in await post.ledger.outbox(head=0)] == ["result"]


async def test_waiting_messages_survive_a_restart(
    router: EmbeddedRouter, tmp_path: Path, received: list[tuple[str, Any]]
) -> None:
    ours = result()
    async with opened(router, tmp_path) as post:
        await post.ledger.post(Outgoing.of(ours))  # and then, before it was sent, a crash
    async with opened(router, tmp_path) as post:
        await listened_to(post)
        await post.outbox.send_all()
        await until(lambda: received)
    assert received[0][1] == ours


async def test_all_messages_are_sent_at_once_when_the_network_is_back(router: EmbeddedRouter, tmp_path: Path) -> None:
    async with opened(router, tmp_path, NEVER) as post:
        await check_sending_on_return(router, post)


async def check_sending_on_return(router: EmbeddedRouter, post: Post) -> None:
    ours, arrived = demand(), [b""]

    async def comes_back() -> bool:
        """False if the client sent before the observer of this test had subscribed."""
        await asyncio.to_thread(router.stop)
        await until(lambda: not post.network.connected)
        await post.outbox.post(ours)
        await asyncio.to_thread(router.start)
        assert router.session is not None
        router.session.declare_subscriber("aira/**", lambda sample: arrived.append(sample.payload.to_bytes()))
        await until(lambda: post.network.connected)
        with suppress(AssertionError):
            await until(lambda: encode(ours) in arrived, seconds=2)
        return encode(ours) in arrived

    async with Background() as tasks:
        tasks.start(post.outbox.run(), "outbox")
        await until_found(comes_back, seconds=60)


async def test_each_message_backs_off_on_its_own(
    router: EmbeddedRouter, tmp_path: Path, received: list[tuple[str, Any]]
) -> None:
    async with opened(router, tmp_path, RetryPolicy(initial=3.0, ceiling=60.0)) as post:
        await listened_to(post)
        first, second = demand(), demand()

        async def sent_at(at: float, *expected: object) -> None:
            """Move the time on; exactly these messages are sent."""
            post.time, before = at, len(received)
            post.outbox.send_due()
            await until(lambda: len(received) == before + len(expected))
            assert [message for _, message in received[before:]] == list(expected)

        await post.outbox.post(first)
        await until(lambda: len(received) == 1)
        await sent_at(2.9)
        await sent_at(3.0, first)
        await post.outbox.post(second)
        await until(lambda: len(received) == 3)
        for at, message in (
            (6, second),
            (9, first),
            (12, second),
            (21, first),
            (24, second),
            (45, first),
            (48, second),
        ):
            await sent_at(at - 0.1)
            await sent_at(at, message)
        await sent_at(93, first)
        await sent_at(96, second)
        await sent_at(152.9)
        await sent_at(153, first)
        await post.outbox.send_all()
        await until(lambda: received[-1][1] == second)
        await sent_at(155.9)
        await sent_at(156, first, second)


async def test_an_order_that_has_expired_keeps_nothing_busy(post: Post, received: list[tuple[str, Any]]) -> None:
    """Until the listener says so, the outbox holds it."""
    await listened_to(post)
    async with Background() as tasks:
        tasks.start(post.outbox.run(), "outbox")
        await post.outbox.post(demand(deadline=10))
        await until(lambda: len(received) >= 2)
        post.head = 10
        await asyncio.sleep(0.3)
        post.rounds, before = 0, len(received)
        await asyncio.sleep(0.5)
        assert (post.rounds, len(received)) == (0, before)


async def test_what_is_settled_while_the_ledger_is_read_is_sent_no_more(
    router: EmbeddedRouter, tmp_path: Path, received: list[tuple[str, Any]]
) -> None:
    async with opened(router, tmp_path, RetryPolicy(initial=3.0)) as post:
        await listened_to(post)
        first, second = demand(), demand()
        await post.outbox.post(first)
        outbox = post.outbox
        await asyncio.gather(outbox.send_new(), outbox.settle(outgoing_identity(first)), outbox.send_new())
        post.time = 100.0
        outbox.send_due()
        await outbox.post(second)
        await until(lambda: received and received[-1][1] == second)
        assert [message for _, message in received] == [first, second]


async def test_a_message_that_is_held_keeps_nothing_busy(post: Post, received: list[tuple[str, Any]]) -> None:
    """As after a reorganisation: sent before, and held until its allowance is ensured."""
    ours = demand()
    await listened_to(post)
    async with Background() as tasks:
        tasks.start(post.outbox.run(), "outbox")
        await post.outbox.post(ours)
        await until(lambda: len(received) >= 2)
        post.outbox.hold([outgoing_identity(ours)])
        await asyncio.sleep(0.3)
        post.rounds = 0
        await asyncio.sleep(0.5)
        assert post.rounds == 0
        received.clear()
        await post.outbox.release([outgoing_identity(ours)])
        await until(lambda: [message for _, message in received[:1]] == [ours])


@pytest.mark.parametrize("role", ["provider", "validator"])
async def test_all_is_sent_at_once_when_a_provider_or_a_validator_appears(
    router: EmbeddedRouter, tmp_path: Path, received: list[tuple[str, Any]], role: str
) -> None:
    ours: list[Demand | Offer | Result] = [demand(), offer(), result()]
    async with opened(router, tmp_path, NEVER) as post, Background() as tasks:
        await listened_to(post)
        for message in ours:
            await post.outbox.post(message)
        tasks.start(post.outbox.run(), "outbox")
        await until(lambda: len(received) == 2 * len(ours), what="all once more at the outbox's own start")
        received.clear()
        async with Network(Endpoints(connect=(router.endpoint,))) as network, Channel(network.session, MARKET) as late:
            late.announce("agent", LIGHTHOUSE)
            late.announce(role, LIGHTHOUSE)
            await until(lambda: len(received) >= len(ours))
            assert sorted(repr(message) for _, message in received) == sorted(map(repr, ours))


async def test_orders_are_dropped_at_their_deadline_block(post: Post) -> None:
    await post.outbox.post(demand(deadline=10))
    await post.outbox.expire(9)
    assert len(await post.ledger.outbox(head=0)) == 1
    await post.outbox.expire(10)
    assert await post.ledger.outbox(head=0) == []


def test_results_are_identified_by_liability_and_orders_by_hash() -> None:
    assert outgoing_identity(result(success=True)) == outgoing_identity(result(success=False)) == f"result {LIGHTHOUSE}"
    one, other = demand(), demand()
    assert outgoing_identity(one) == message_hash(one).hex() != outgoing_identity(other)


def test_an_entry_has_the_kind_payload_and_deadline_of_its_message() -> None:
    order = demand(deadline=77)
    assert (Outgoing.of(order).kind, Outgoing.of(order).deadline) == ("demand", 77)
    assert (Outgoing.of(result()).kind, Outgoing.of(result()).deadline) == ("result", None)
    assert decode(Outgoing.of(order).payload) == order
