"""The channel between two agents on a real router: what arrives, and what is refused."""

from __future__ import annotations

import asyncio
from typing import Any

import pytest
import zenoh

from mesh.errors import ClosedError, InputError, InvalidKey
from mesh.network import Channel, Endpoints, Network, ValidationStatistics, message_key, pump
from schemas import Demand, Offer, Result, SignedMessage, Verified, encode, message_hash
from tests.support.network.channels import KEY, ORDER, contents, listening, opened, take
from tests.support.orders import (
    MARKET,
    MODEL,
    OTHER_MODEL,
    PERSON,
    ROBOT,
    STRANGER,
    demand,
    offer,
    result,
    terms,
)
from tests.support.ports import free_endpoint
from tests.support.waiting import until


@pytest.mark.parametrize("kind_of_router", ["router", "zenohd"])
async def test_each_kind_of_message_arrives_verified(kind_of_router: str, request: pytest.FixtureRequest) -> None:
    endpoints = Endpoints(connect=(request.getfixturevalue(kind_of_router).endpoint,))
    async with Network(endpoints) as mine, Network(endpoints) as yours:
        here, there = mine.session, yours.session
        async with (
            listening(here, there, Demand) as (demands, theirs),
            listening(here, there, Offer) as (offers, _),
            listening(here, there, Result) as (results, _),
        ):
            messages: list[SignedMessage] = [demand(), offer(), result()]
            keys = [theirs.publish(message) for message in messages]

            for message, key, arriving, signer in zip(
                messages, keys, (demands, offers, results), (PERSON, ROBOT, ROBOT), strict=True
            ):
                assert await take(arriving, 1) == [Verified(message, message_hash(message), signer.address)]
                assert key == message_key(MARKET, message)


async def test_a_burst_arrives_complete() -> None:
    endpoint = free_endpoint()
    burst = [demand() for _ in range(1000)]
    async with (
        Network(Endpoints(mode="router", listen=(endpoint,))),
        Network(Endpoints(connect=(endpoint,))) as mine,
        Network(Endpoints(connect=(endpoint,))) as yours,
        listening(mine.session, yours.session) as (demands, theirs),
    ):
        for message in burst:
            theirs.publish(message)

        assert contents(await take(demands, len(burst))) == burst


async def test_an_agent_receives_its_own_messages(here: zenoh.Session) -> None:
    async with opened(here) as channel, channel.subscribe(Demand) as demands:
        channel.publish(message := demand())

        assert contents(await take(demands, 1)) == [message]


async def test_the_lighthouse_may_be_written_in_any_case(here: zenoh.Session, there: zenoh.Session) -> None:
    async with (
        Channel(here, MARKET.upper()) as ours,
        listening(here, there) as (demands, _),
    ):
        ours.publish(message := demand())

        assert contents(await take(demands, 1)) == [message]


async def test_messages_of_another_lighthouse_do_not_arrive(here: zenoh.Session, there: zenoh.Session) -> None:
    async with (
        listening(here, there) as (demands, theirs),
        Channel(there, "other.lighthouse.3.robonomics.eth") as other,
    ):
        other.publish(demand())
        theirs.publish(message := demand())

        assert contents(await take(demands, 1)) == [message]
        assert demands.statistics().received == 1


@pytest.mark.parametrize(("kind", "make"), [(Demand, demand), (Offer, offer)])
async def test_orders_of_other_models_are_filtered_at_the_source(
    here: zenoh.Session, there: zenoh.Session, kind: type[Any], make: Any
) -> None:
    async with listening(here, there, kind, model=MODEL) as (orders, theirs):
        for _ in range(50):
            theirs.publish(make(model=OTHER_MODEL))
        theirs.publish(message := make(model=MODEL))

        assert contents(await take(orders, 1)) == [message]
        assert orders.statistics() == ValidationStatistics(received=1, accepted=1, invalid={}, duplicate=0, dropped=0)


async def test_a_selection_that_keys_can_not_express_is_rejected(here: zenoh.Session) -> None:
    async with opened(here) as channel:
        with pytest.raises(InvalidKey):
            channel.subscribe(Result, model=MODEL)
        with pytest.raises(InputError):
            channel.subscribe(Demand, model="**")


FORGED = Demand(**terms(), validator_fee=0, signature="ff" * 65)
ELSEWHERE = demand(lighthouse=STRANGER.address)
LATE = demand(deadline=7)
REJECTED = {
    "other model's key": ("key", KEY.replace(MODEL, OTHER_MODEL), encode(ORDER)),
    "wildcard for the model": ("key", KEY.replace(MODEL, "*"), encode(ORDER)),
    "wildcard for everything": ("key", "aira/**", encode(ORDER)),
    "other lighthouse in the order": ("lighthouse", message_key(MARKET, ELSEWHERE), encode(ELSEWHERE)),
    "deadline that has passed": ("deadline", message_key(MARKET, LATE), encode(LATE)),
    "no JSON": ("not-json", KEY, b"\x00\xff"),
    "bad signature": ("signature", message_key(MARKET, FORGED), encode(FORGED)),
    "message of another kind": ("kind", KEY, encode(offer())),
}


async def test_each_rejection_is_counted_under_its_reason_and_valid_messages_still_arrive(
    here: zenoh.Session, there: zenoh.Session
) -> None:
    async with listening(here, there, head=lambda: 7) as (demands, theirs):
        expected: dict[str, int] = {}
        for reason, key, payload in REJECTED.values():
            there.put(key, payload)
            expected[reason] = expected.get(reason, 0) + 1
        theirs.publish(ORDER)

        assert contents(await take(demands, 1)) == [ORDER]
        assert demands.statistics() == ValidationStatistics(
            received=len(REJECTED) + 1, accepted=1, invalid=expected, duplicate=0, dropped=0
        )


async def test_a_message_that_is_sent_again_arrives_once(here: zenoh.Session, there: zenoh.Session) -> None:
    async with listening(here, there) as (demands, theirs):
        first, last = demand(), demand()
        for message in (first, first, first, last):
            theirs.publish(message)

        assert contents(await take(demands, 2)) == [first, last]
        assert demands.statistics().duplicate == 2


async def test_equal_terms_signed_by_two_people_are_two_messages(here: zenoh.Session, there: zenoh.Session) -> None:
    same = terms()
    async with listening(here, there) as (demands, theirs):
        for signer in (PERSON, STRANGER):
            theirs.publish(signer.sign(Demand(**same, validator_fee=0)))

        assert [one.signer for one in await take(demands, 2)] == [PERSON.address, STRANGER.address]


async def test_a_forgotten_message_arrives_again(here: zenoh.Session, there: zenoh.Session) -> None:
    async with listening(here, there) as (demands, theirs):
        theirs.publish(message := demand())
        (arrived,) = await take(demands, 1)

        demands.forget(arrived)
        theirs.publish(message)

        assert await take(demands, 1) == [arrived]


async def test_a_slow_consumer_loses_the_oldest_messages_and_gets_the_newest_first(
    here: zenoh.Session, there: zenoh.Session
) -> None:
    sent = [demand() for _ in range(pump.PUMP_LIMITS.samples + 2000)]
    block = zenoh.CongestionControl.BLOCK
    async with listening(here, there) as (demands, _):
        for count, message in enumerate(sent, 1):
            there.put(message_key(MARKET, message), encode(message), congestion_control=block)
            if count % (pump.PUMP_PACE.resent_queue // 2) == 0:
                await until(lambda: demands.statistics().received == count)  # noqa: B023
        await until(lambda: demands.statistics().received == len(sent))

        taken = [one.hash for one in await take(demands, len(sent) - demands.statistics().dropped)]

        number_of: dict[bytes, int] = {message_hash(message): number for number, message in enumerate(sent)}
        numbers = [number_of[each] for each in taken]
        dropped = set(range(len(sent))) - set(numbers)
        assert len(dropped) == demands.statistics().dropped > 0
        assert max(dropped) < len(sent) - pump.PUMP_LIMITS.samples
        first = numbers[: (pump.PUMP_PACE.batches + 1) * pump.PUMP_PACE.batch]
        assert len(sent) - 1 in first, "it waited only for batches that were taken before"
        rest = numbers[-pump.RING_LIMITS.in_order :]
        assert rest == sorted(rest)


async def test_leaving_a_subscription_ends_its_iteration(here: zenoh.Session, there: zenoh.Session) -> None:
    async with listening(here, there) as (demands, theirs):
        taken: list[Verified[Demand]] = []

        async def consume() -> None:
            async for one in demands:
                taken.append(one)

        consuming = asyncio.create_task(consume())
        theirs.publish(demand())
        await until(lambda: taken)

    async with asyncio.timeout(60):
        await consuming
    assert len(taken) == 1


async def test_an_unsigned_message_is_not_published(here: zenoh.Session) -> None:
    async with opened(here) as channel:
        with pytest.raises(InputError) as error:
            channel.publish(Demand(**terms(), validator_fee=0))
    assert "sign it first" in error.value.hint


async def test_nothing_is_put_on_a_key_with_a_wildcard(here: zenoh.Session) -> None:
    async with opened(here) as channel:
        with pytest.raises(InvalidKey):
            channel.put(f"aira/{MARKET}/demand/*", b"")


@pytest.mark.parametrize("name", ["", "a b.eth", "a/b.eth", "*", "**", "a$*.eth", "@agent", "line\n.eth"])
async def test_a_lighthouse_name_that_no_key_may_contain_is_rejected(here: zenoh.Session, name: str) -> None:
    with pytest.raises(InvalidKey):
        Channel(here, name)


async def test_a_channel_is_used_inside_async_with(here: zenoh.Session) -> None:
    channel = Channel(here, MARKET)
    for _ in range(2):
        for use in (
            lambda: channel.publish(demand()),
            lambda: channel.put("aira/x", b""),
            lambda: channel.subscribe(Demand),
            lambda: channel.watch_presence(print),
            lambda: channel.announce("agent", PERSON.address),
        ):
            with pytest.raises(ClosedError):
                use()
        with pytest.raises(ClosedError):
            await channel.present()
        async with channel:
            with pytest.raises(ClosedError):
                await channel.__aenter__()


async def test_a_subscription_is_used_inside_async_with(here: zenoh.Session) -> None:
    async with opened(here) as channel:
        demands = channel.subscribe(Demand)
        with pytest.raises(ClosedError):
            await anext(demands)
        with pytest.raises(ClosedError):
            await demands.recall()
