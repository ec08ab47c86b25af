"""The pump between Zenoh's threads and the event loop: order, exact counts, and an end that never hangs."""

from __future__ import annotations

import asyncio
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING, Any

import pytest
import zenoh

from mesh.base.flood import Drops
from mesh.errors import ClosedError
from mesh.network import Pump, PumpLimits, pump
from mesh.network.pump import ResentConversion
from tests.support.waiting import at_most, until, until_heard

if TYPE_CHECKING:
    from collections.abc import Iterator

KEY = "test/numbers"
LAST = -1


def number(sample: zenoh.Sample) -> int:
    return int(sample.payload.to_bytes())


def numbers_of(samples: list[zenoh.Sample]) -> list[int]:
    return list(map(number, samples))


def put(session: zenoh.Session, *numbers: int) -> None:
    """Put the numbers, and lose none of them on the way."""
    for value in numbers:
        session.put(KEY, str(value).encode(), congestion_control=zenoh.CongestionControl.BLOCK)


async def take(numbers: Pump[int], count: int) -> list[int]:
    async with asyncio.timeout(60):
        return [await anext(numbers) for _ in range(count)]


async def take_to_last(numbers: Pump[int]) -> list[int]:
    taken = []
    async with asyncio.timeout(60):
        while (value := await anext(numbers)) != LAST:
            taken.append(value)
    return taken


def feed_all(numbers: Pump[int], samples: list[zenoh.Sample]) -> None:
    for sample in samples:
        numbers.feed([copied(numbers, sample)])


def copied(numbers: Pump[int], sample: zenoh.Sample) -> Any:
    taken = numbers.copy(sample)
    assert taken is not None
    return taken


def pumps_running() -> list[str]:
    return [thread.name for thread in threading.enumerate() if thread.name.startswith("pump ")]


async def test_samples_arrive_in_order(here: zenoh.Session, there: zenoh.Session) -> None:
    async with Pump(here, KEY, number) as numbers:
        await until_heard(there, KEY)
        put(there, *range(2000))

        assert await take(numbers, 2000) == list(range(2000))
        assert (numbers.received, numbers.dropped) == (2000, 0)


async def test_samples_converted_to_none_are_skipped(here: zenoh.Session, there: zenoh.Session) -> None:
    def even(sample: zenoh.Sample) -> int | None:
        return number(sample) if number(sample) % 2 == 0 else None

    async with Pump(here, KEY, even) as numbers:
        await until_heard(there, KEY)
        put(there, *range(1000))

        assert await take(numbers, 500) == list(range(0, 1000, 2))


async def test_the_conversion_runs_on_the_pumps_thread(here: zenoh.Session, there: zenoh.Session) -> None:
    async with Pump(here, KEY, lambda _: threading.current_thread().name) as names:
        await until_heard(there, KEY)
        put(there, 1)

        assert await anext(names) == f"pump {KEY}"


async def test_a_slow_consumer_loses_the_oldest_samples_and_each_is_counted(
    here: zenoh.Session, there: zenoh.Session
) -> None:
    async with Pump(here, KEY, number, limits=PumpLimits(samples=64)) as numbers:
        await until_heard(there, KEY)
        await asyncio.to_thread(put, there, *range(5000))
        put(there, LAST)
        await until(lambda: numbers.received == 5001)
        taken = await take_to_last(numbers)

        assert taken == sorted(taken)
        assert taken[-63:] == list(range(5000 - 63, 5000))
        assert numbers.dropped > 0
        assert numbers.received == len(taken) + 1 + numbers.dropped


async def test_the_ring_is_bounded_in_bytes(here: zenoh.Session, there: zenoh.Session) -> None:
    drops = Drops()
    async with Pump(here, KEY, number, limits=PumpLimits(size=200), drops=drops) as numbers:
        await until_heard(there, KEY)
        await asyncio.to_thread(put, there, *range(10_000, 15_000))
        put(there, LAST)
        await until(lambda: numbers.received == 5001)
        taken = await take_to_last(numbers)

        assert taken[-39:] == list(range(15_000 - 39, 15_000)), "39 with five bytes each, and the last"
        assert numbers.received == len(taken) + 1 + numbers.dropped
        assert drops.totals() == {"overflow": numbers.dropped}


async def test_too_large_payloads_are_refused_live_and_fed(here: zenoh.Session, there: zenoh.Session) -> None:
    drops, fed = Drops(), await some_samples(here, there, 1)
    async with Pump(here, KEY, number, limits=PumpLimits(payload=2), drops=drops) as numbers:
        await until_heard(there, KEY)
        put(there, 1, 100, 99, 100, 2)

        assert await take(numbers, 3) == [1, 99, 2]
        assert numbers.copy(fed[0]) is not None
        assert (numbers.received, numbers.dropped) == (6, 0)
        assert drops.totals() == {"too-large": 2}


async def test_expensive_conversions_get_copies_in_batches(here: zenoh.Session, there: zenoh.Session) -> None:
    sizes: list[int] = []

    def convert_all(copies: list[int]) -> Iterator[list[int]]:
        sizes.append(len(copies))
        while numbers.received < 3000:  # Zenoh's queue, which holds fewer, is emptied meanwhile
            yield []
        for value in copies:
            yield [value] if value % 2 else []

    async with Pump(here, KEY, ResentConversion(numbers_of, convert_all)) as numbers:
        await until_heard(there, KEY)
        for first in (0, 1000, 2000):
            put(there, *range(first, first + 1000))
            await until(lambda first=first: numbers.received == first + 1000)  # type: ignore[misc]

        assert sorted(await take(numbers, 1500)) == list(range(1, 3000, 2)), "the newest first, as so many waited"
        assert max(sizes) <= pump.PUMP_PACE.batch


async def test_a_flood_of_what_is_sent_again_does_not_hold_up_other_keys(
    here: zenoh.Session, there: zenoh.Session
) -> None:
    is_over = threading.Event()

    def convert_all(copies: list[int]) -> Iterator[list[int]]:
        is_over.wait()
        yield copies

    flooded = Pump(here, KEY, ResentConversion(numbers_of, convert_all))
    async with flooded, Pump(here, "test/elsewhere", number) as others:
        await until_heard(there, KEY)
        await until_heard(there, "test/elsewhere")
        for value in range(2 * pump.PUMP_PACE.resent_queue):
            there.put(KEY, str(value).encode())
        there.put("test/elsewhere", b"1")
        try:
            assert await take(others, 1) == [1]
        finally:
            is_over.set()


async def test_a_cancelled_consumer_loses_nothing(here: zenoh.Session, there: zenoh.Session) -> None:
    async with Pump(here, KEY, number) as numbers:
        await until_heard(there, KEY)
        waiting = asyncio.create_task(anext(numbers))
        await asyncio.sleep(0)
        waiting.cancel()
        put(there, 1, 2, 3)

        assert await take(numbers, 3) == [1, 2, 3]


async def test_fed_samples_are_delivered_beside_live_ones(here: zenoh.Session, there: zenoh.Session) -> None:
    samples = await some_samples(here, there, 3)

    async with Pump(here, "test/elsewhere", number) as numbers:
        for sample in samples:
            numbers.feed([copied(numbers, sample)])

        assert await take(numbers, 3) == [0, 1, 2]
        assert numbers.received == 3


async def test_feeding_never_waits_for_the_consumer(here: zenoh.Session, there: zenoh.Session) -> None:
    (sample,) = await some_samples(here, there, 1)

    async with Pump(here, "test/elsewhere", number) as numbers:
        with at_most(5):
            for _ in range(2_000):
                numbers.feed([copied(numbers, sample)])

        assert await take(numbers, 2_000) == [0] * 2_000
        assert (numbers.received, numbers.dropped) == (2_000, 0)


async def test_counts_are_exact_when_threads_feed_while_samples_arrive(
    here: zenoh.Session, there: zenoh.Session
) -> None:
    samples = await some_samples(here, there, 500)

    async with Pump(here, KEY, number, limits=PumpLimits(samples=100_000)) as numbers:
        await until_heard(there, KEY)
        with ThreadPoolExecutor(4) as threads:
            for _ in range(3):
                threads.submit(feed_all, numbers, samples)
            threads.submit(put, there, *range(500))

        assert sorted(await take(numbers, 2000)) == sorted([*range(500)] * 4)
        assert (numbers.received, numbers.dropped) == (2000, 0)


async def test_leaving_ends_a_waiting_iteration(here: zenoh.Session) -> None:
    async with Pump(here, KEY, number) as numbers:
        consuming = asyncio.create_task(collect(numbers))
        await asyncio.sleep(0)

    async with asyncio.timeout(60):
        assert await consuming == []
    with pytest.raises(StopAsyncIteration):
        await anext(numbers)


@pytest.mark.parametrize("capacity", [64, 8192])
async def test_leaving_does_not_wait_for_a_stalled_consumer(
    here: zenoh.Session, there: zenoh.Session, capacity: int
) -> None:
    numbers = await Pump(here, KEY, number, limits=PumpLimits(samples=capacity)).__aenter__()
    await until_heard(there, KEY)
    put(there, *range(3000))
    await until(lambda: numbers.received == 3000)

    with at_most(2):
        await numbers.__aexit__(None, None, None)

    assert not pumps_running()


async def test_leaving_after_the_session_was_closed_does_not_hang(here: zenoh.Session) -> None:
    with at_most(2):
        async with Pump(here, KEY, number):
            here.close()  # type: ignore[no-untyped-call]

    assert not pumps_running()


async def test_closing_the_session_ends_the_iteration_with_an_error(here: zenoh.Session) -> None:
    async with Pump(here, KEY, number) as numbers:
        consuming = asyncio.create_task(take(numbers, 1))
        await asyncio.sleep(0)
        here.close()  # type: ignore[no-untyped-call]

        with at_most(2), pytest.raises(ClosedError):
            await consuming


async def test_no_thread_is_left_when_the_subscription_fails(here: zenoh.Session) -> None:
    here.close()  # type: ignore[no-untyped-call]

    with pytest.raises(zenoh.ZError):
        await Pump(here, KEY, number).__aenter__()

    assert not pumps_running()


async def test_an_error_of_the_conversion_is_raised_after_the_samples_before_it(
    here: zenoh.Session, there: zenoh.Session
) -> None:
    everything: list[zenoh.Sample] = []

    def number_when_all_are_there(sample: zenoh.Sample) -> int:
        value = number(sample)
        while len(everything) < 4:
            time.sleep(0.001)
        return value

    async with Pump(here, KEY, number_when_all_are_there) as numbers:
        here.declare_subscriber(KEY, everything.append)
        await until_heard(there, KEY)
        put(there, 1, 2, 3)
        there.put(KEY, b"no number")
        assert await take(numbers, 3) == [1, 2, 3]

        for _ in range(2):
            with pytest.raises(ValueError, match="no number"):
                await take(numbers, 1)

        others: list[zenoh.Sample] = []
        with here.declare_subscriber("test/others", others.append):
            await until_heard(there, "test/others")
            await asyncio.to_thread(put, there, *range(2 * pump.PUMP_PACE.queue))
            there.put("test/others", b"")
            await until(lambda: others, what="samples for others after the pump has failed")

    assert not pumps_running()


async def test_a_pump_is_used_inside_async_with_and_once(here: zenoh.Session) -> None:
    numbers = Pump(here, KEY, number)
    with pytest.raises(ClosedError):
        await anext(numbers)

    async with numbers:
        pass

    with pytest.raises(ClosedError):
        await numbers.__aenter__()


async def collect(numbers: Pump[int]) -> list[int]:
    return [value async for value in numbers]


async def some_samples(here: zenoh.Session, there: zenoh.Session, count: int) -> list[zenoh.Sample]:
    """Samples with the numbers from 0 on, as a subscriber gets them."""
    samples: list[zenoh.Sample] = []
    with here.declare_subscriber(KEY, samples.append):
        await until_heard(there, KEY)
        put(there, *range(count))
        await until(lambda: len(samples) == count)
    return samples
