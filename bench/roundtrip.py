"""A round trip through a router: a signed demand out, a signed offer back, both verified; against bare Zenoh.

Two processes and a router in a third. The bare round trip sends the same bytes on the same keys and answers from
Zenoh's own callback. What two recoveries of a signer cost by themselves is shown apart: no channel can be faster.
"""

from __future__ import annotations

import asyncio
import multiprocessing
import statistics
import time
from typing import Any, Final

from mesh.network import Channel, Endpoints, Network, free_endpoint
from messages import recover_bare, route
from orders import ADDRESS, LIGHTHOUSE, signed_demands
from report import arguments, show
from schemas import Demand, Offer, Signer, encode

PING: Final = "aira/bench/ping"
PONG: Final = "aira/bench/pong"


def signed_offers(count: int) -> list[Offer]:
    """Offers that answer nothing in particular, each signed."""
    signer = Signer(b"\1" * 32)
    fields = ("model", "objective", "token", "cost", "lighthouse", "validator", "deadline", "nonce")
    return [
        signer.sign(Offer(**{field: getattr(demand, field) for field in fields}, lighthouse_fee=0))
        for demand in signed_demands(count)
    ]


def echo(endpoint: str, count: int, ready: Any, done: Any) -> None:
    """The answering process."""
    asyncio.run(_echo(endpoint, count, ready, done))


async def _echo(endpoint: str, count: int, ready: Any, done: Any) -> None:
    answers = iter(signed_offers(count))
    async with (
        Network(Endpoints(connect=(endpoint,))) as network,
        Channel(network.session, LIGHTHOUSE, address=ADDRESS) as channel,
        channel.subscribe(Demand) as demands,
    ):
        network.session.declare_subscriber(
            PING, lambda sample: network.session.put(PONG, sample.payload.to_bytes(), express=True)
        )
        await asyncio.sleep(0.5)  # the router learns of the subscriptions
        ready.set()
        async for _ in demands:
            channel.publish(next(answers))
            if done.is_set():
                break


async def measure(endpoint: str, count: int) -> tuple[list[float], list[float]]:
    """Seconds of each bare and each verified round trip, taken in turns."""
    orders = signed_demands(count)
    bare: list[float] = []
    verified: list[float] = []
    loop = asyncio.get_running_loop()
    async with (
        Network(Endpoints(connect=(endpoint,))) as network,
        Channel(network.session, LIGHTHOUSE, address=ADDRESS) as channel,
        channel.subscribe(Offer) as offers,
    ):
        returned = asyncio.Event()
        network.session.declare_subscriber(PONG, lambda _: loop.call_soon_threadsafe(returned.set))
        await asyncio.sleep(0.5)
        for order in orders:
            started = time.perf_counter()
            returned.clear()
            network.session.put(PING, encode(order), express=True)
            await returned.wait()
            bare.append(time.perf_counter() - started)
            started = time.perf_counter()
            channel.publish(order)
            await anext(offers)
            verified.append(time.perf_counter() - started)
    return bare, verified


def main() -> None:
    """Run it."""
    options = arguments("verified round trip against bare Zenoh", count=3000)
    spawn = multiprocessing.get_context("spawn")
    endpoint, ready, done = free_endpoint(), spawn.Event(), spawn.Event()
    router = spawn.Process(target=route, args=(endpoint,), daemon=True)
    router.start()
    answering = spawn.Process(target=echo, args=(endpoint, options.count, ready, done), daemon=True)
    answering.start()
    ready.wait(60)
    bare, verified = asyncio.run(measure(endpoint, options.count))
    signature = 1 / recover_bare(signed_demands(500))
    answering.terminate()
    router.terminate()
    median, bare_median = statistics.median(verified), statistics.median(bare)
    figures = {
        "verified_ms": round(median * 1e3, 3),
        "bare_ms": round(bare_median * 1e3, 3),
        "ratio": round(median / bare_median, 3),
        "signatures_ms": round(2 * signature * 1e3, 3),
        "ratio_without_signatures": round((median - 2 * signature) / bare_median, 3),
        "verified_p99_ms": round(statistics.quantiles(verified, n=100)[98] * 1e3, 3),
        "bare_p99_ms": round(statistics.quantiles(bare, n=100)[98] * 1e3, 3),
    }
    show(figures, as_json=options.json)


if __name__ == "__main__":
    main()
