"""Putting messages: which are sent at once, and which wait for a batch."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import pytest

from mesh.network import Endpoints, Network, sending
from tests.support.clocks import SECOND, SetClock
from tests.support.network.channels import listening, take
from tests.support.orders import demand
from tests.support.waiting import until, until_heard

if TYPE_CHECKING:
    import zenoh

    from tests.support.routers import EmbeddedRouter

KEY = "aira/test"


@pytest.fixture
def clock() -> SetClock:
    return SetClock()


async def test_a_message_on_a_quiet_session_is_sent_at_once_and_those_right_after_it_in_batches(
    here: zenoh.Session, clock: SetClock
) -> None:
    heard: list[bool] = []
    subscriber: Any = here.declare_subscriber(KEY, lambda sample: heard.append(sample.express))
    for pause in (
        0.0,
        0.0,
        sending.SENDING_PACE.quiet / 2,
        sending.SENDING_PACE.quiet / 2,
        sending.SENDING_PACE.quiet * 1.01,
        0.0,
    ):
        clock.pass_by(round(pause * SECOND))
        sending.put(here, KEY, b"", clock=clock)
    await until(lambda: len(heard) == 6)
    assert heard == [True, False, False, False, True, False]
    subscriber.undeclare()


async def test_of_a_stream_only_the_beginning_is_sent_at_once(here: zenoh.Session, clock: SetClock) -> None:
    heard: list[bool] = []
    subscriber: Any = here.declare_subscriber(KEY, lambda sample: heard.append(sample.express))
    for _ in range(100):
        clock.pass_by(round(sending.SENDING_PACE.quiet * 1.01 * SECOND))
        sending.put(here, KEY, b"", clock=clock)
    await until(lambda: len(heard) == 100)
    assert heard[:8] == [True] * 8
    assert sum(heard[8:]) == 4, "as much as the credit of 23 ms"
    subscriber.undeclare()


async def test_a_conversation_is_sent_at_once_throughout(
    here: zenoh.Session, there: zenoh.Session, clock: SetClock
) -> None:
    """Each order is answered before the next one is sent."""
    async with listening(here, there) as (demands, theirs):
        heard: list[bool] = []
        subscriber: Any = there.declare_subscriber(KEY, lambda sample: heard.append(sample.express))
        await until_heard(here, KEY)
        for _ in range(30):
            clock.pass_by(round(sending.SENDING_PACE.quiet * 1.01 * SECOND))
            theirs.publish(demand())
            await take(demands, 1)
            sending.put(here, KEY, b"", clock=clock)
        await until(lambda: len(heard) == 30)
        assert heard == [True] * 30
        subscriber.undeclare()


async def test_each_session_has_its_own_quiet(here: zenoh.Session, there: zenoh.Session, clock: SetClock) -> None:
    heard: list[bool] = []
    subscriber: Any = here.declare_subscriber(KEY, lambda sample: heard.append(sample.express))
    sending.put(here, KEY, b"", clock=clock)
    sending.put(here, KEY, b"", clock=clock)
    await until(lambda: len(heard) == 2)
    there_heard: list[bool] = []
    # On a key of its own: what was put here may still be under way.
    other: Any = there.declare_subscriber(f"{KEY}/there", lambda sample: there_heard.append(sample.express))
    sending.put(there, f"{KEY}/there", b"", clock=clock)
    await until(lambda: there_heard)
    assert (heard[:2], there_heard[0]) == ([True, False], True)
    other.undeclare()
    subscriber.undeclare()


async def test_a_closed_session_is_forgotten(router: EmbeddedRouter) -> None:
    async with Network(Endpoints(connect=(router.endpoint,))) as network:
        identity = id(network.session)
        sending.put(network.session, KEY, b"")
        assert identity in sending._paces
    assert identity not in sending._paces
