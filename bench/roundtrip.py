"""The round trip of a signed demand and a signed offer through a router, both verified, compared with bare Zenoh.

There are two processes with an event loop each, and a router process. The bare round trip sends the same bytes; Zenoh's
callback passes them to the event loop, which answers: what an agent would do without a channel. The time of two
signature recoveries is shown separately, and so is a round trip that is answered in Zenoh's own thread.

Then demands are sent as fast as possible, and in the pace at which each is sent at once instead of in a batch; a third
process counts what arrives. The bars: at most 2.3 times bare Zenoh, and no message lost.
"""

from __future__ import annotations

import asyncio
import statistics
import sys
import time
from typing import Any, Final

from common import ADDRESS, LIGHTHOUSE, SPAWN, arguments, router, show, signed_demands
from mesh.network import Channel, Endpoints, MarketRules, Network
from messages import compact, recover_key
from schemas import Demand, Offer, Signer, encode

PING: Final = "aira/bench/ping"
CALLBACK_PING: Final = "aira/bench/callback/ping"
PONG: Final = "aira/bench/pong"
BAR: Final = 2.3
PACED: Final = 5000
PACE: Final = 0.0003
"""Seconds between two messages: a little more than `mesh.network.sending.SENDING_PACE.quiet`."""
BURSTS: Final = 3
BURST: Final = 2000
ARRIVAL_TIMEOUT: Final = 5.0
"""Seconds after the last message in which another one must arrive, or the rest counts as lost."""


def signed_offers(count: int) -> list[Offer]:
    """Signed offers that match no demand."""
    signer = Signer(b"\1" * 32)
    fields = ("model", "objective", "token", "cost", "lighthouse", "validator", "deadline", "nonce")
    return [
        signer.sign(Offer(**{field: getattr(demand, field) for field in fields}, lighthouse_fee=0))
        for demand in signed_demands(count)
    ]


def echo(endpoint: str, count: int, ready: Any, done: Any) -> None:
    """The process that answers."""
    asyncio.run(_echo(endpoint, count, ready, done))


async def _echo(endpoint: str, count: int, ready: Any, done: Any) -> None:
    answers = iter(signed_offers(count))
    async with (
        Network(Endpoints(connect=(endpoint,))) as network,
        Channel(network.session, MarketRules(LIGHTHOUSE, address=ADDRESS)) as channel,
        channel.subscribe(Demand) as demands,
    ):
        loop = asyncio.get_running_loop()

        def answer(sample: Any) -> None:
            network.session.put(PONG, sample.payload.to_bytes(), express=True)

        network.session.declare_subscriber(PING, lambda sample: loop.call_soon_threadsafe(answer, sample))
        network.session.declare_subscriber(CALLBACK_PING, answer)
        await asyncio.sleep(0.5)  # the router learns of the subscriptions
        ready.set()
        async for _ in demands:
            channel.publish(next(answers))
            if done.is_set():
                break


async def measure(endpoint: str, count: int) -> dict[str, list[float]]:
    """Seconds of each round trip; the kinds alternate."""
    taken: dict[str, list[float]] = {"bare": [], "callback": [], "verified": [], "signature": []}
    loop = asyncio.get_running_loop()
    async with (
        Network(Endpoints(connect=(endpoint,))) as network,
        Channel(network.session, MarketRules(LIGHTHOUSE, address=ADDRESS)) as channel,
        channel.subscribe(Offer) as offers,
    ):
        returned = asyncio.Event()
        network.session.declare_subscriber(PONG, lambda _: loop.call_soon_threadsafe(returned.set))
        await asyncio.sleep(0.5)
        for order in signed_demands(count):
            payload = encode(order)
            for kind, key in (("bare", PING), ("callback", CALLBACK_PING)):
                returned.clear()
                started = time.perf_counter()
                network.session.put(key, payload, express=True)
                await returned.wait()
                taken[kind].append(time.perf_counter() - started)
            started = time.perf_counter()
            channel.publish(order)
            await anext(offers)
            taken["verified"].append(time.perf_counter() - started)
            taken["signature"].append(recover_once(order))
    return taken


def recover_once(order: Demand) -> float:
    """Seconds of one recovery between round trips, with cold caches."""
    signature, digest = compact(order)
    started = time.perf_counter()
    recover_key(signature, digest)
    return time.perf_counter() - started


def count_arrivals(endpoint: str, arrived: Any, ready: Any) -> None:
    """The process that counts verified demands."""

    async def run() -> None:
        async with (
            Network(Endpoints(connect=(endpoint,))) as network,
            Channel(network.session, MarketRules(LIGHTHOUSE, address=ADDRESS)) as channel,
            channel.subscribe(Demand) as demands,
        ):
            await asyncio.sleep(0.5)  # the router learns of the subscription
            ready.set()
            async for _ in demands:
                arrived.value += 1

    asyncio.run(run())


def wait_until(due: float) -> None:
    """Return at that time; asyncio's clock is too coarse for this."""
    while (left := due - time.monotonic()) > 0:
        time.sleep(left)


async def burst(endpoint: str, number: int, pace: float, arrived: Any) -> int:
    """Publish that many demands, `pace` seconds apart; how many did not arrive."""
    orders, before, due = signed_demands(number), int(arrived.value), time.monotonic() + 0.5
    async with (
        Network(Endpoints(connect=(endpoint,))) as network,
        Channel(network.session, MarketRules(LIGHTHOUSE, address=ADDRESS)) as channel,
    ):
        await asyncio.sleep(0.5)
        for order in orders:
            channel.publish(order)
            if pace:
                wait_until(due := due + pace)
        seen, since = arrived.value, time.monotonic()
        while (now := arrived.value) < before + number and time.monotonic() - since < ARRIVAL_TIMEOUT:
            if now != seen:
                seen, since = now, time.monotonic()
            await asyncio.sleep(0.05)
    return before + number - int(arrived.value)


def losses(endpoint: str) -> dict[str, int]:
    """How many messages of a paced burst, and of several unpaced ones, did not arrive."""
    arrived, ready = SPAWN.Value("l", 0), SPAWN.Event()
    counting = SPAWN.Process(target=count_arrivals, args=(endpoint, arrived, ready), daemon=True)
    counting.start()
    assert ready.wait(60)
    lost_paced = asyncio.run(burst(endpoint, PACED, PACE, arrived))
    lost_bursts = sum(asyncio.run(burst(endpoint, BURST, 0, arrived)) for _ in range(BURSTS))
    counting.terminate()
    return {"lost_paced": lost_paced, "lost_bursts": lost_bursts}


def main() -> None:
    """Run the benchmark."""
    options = arguments("verified round trip against bare Zenoh", count=3000)
    ready, done = SPAWN.Event(), SPAWN.Event()
    with router() as (endpoint, _):
        answering = SPAWN.Process(target=echo, args=(endpoint, options.count, ready, done), daemon=True)
        answering.start()
        ready.wait(60)
        taken = asyncio.run(measure(endpoint, options.count))
        answering.terminate()
        lost = losses(endpoint)
    median = {kind: statistics.median(seconds) for kind, seconds in taken.items()}
    results: dict[str, Any] = {
        "verified_ms": round(median["verified"] * 1e3, 3),
        "bare_ms": round(median["bare"] * 1e3, 3),
        "ratio": round(median["verified"] / median["bare"], 3),
        "signatures_ms": round(2 * median["signature"] * 1e3, 3),
        "ratio_without_signatures": round((median["verified"] - 2 * median["signature"]) / median["bare"], 3),
        "callback_ms": round(median["callback"] * 1e3, 3),
        "verified_p99_ms": round(statistics.quantiles(taken["verified"], n=100)[98] * 1e3, 3),
        "bare_p99_ms": round(statistics.quantiles(taken["bare"], n=100)[98] * 1e3, 3),
        **lost,
    }
    bars = {
        f"a verified round trip takes {results['ratio']} times the bare one": results["ratio"] <= BAR,
        "messages were lost": not any(lost.values()),
    }
    results["missed"] = [bar for bar, is_met in bars.items() if not is_met]
    show(results, as_json=options.json)
    sys.exit(bool(results["missed"]))


if __name__ == "__main__":
    main()
