"""A round trip through a router: a signed demand out, a signed offer back, both verified; against bare Zenoh.

Two processes with an event loop each, and a router in a third. The bare round trip sends the same bytes, which Zenoh's
callback hands to the event loop that answers: what an agent would do without a channel. What two recoveries of a signer
cost by themselves is shown apart, and so is a round trip that is answered in Zenoh's own thread.
"""

from __future__ import annotations

import asyncio
import multiprocessing
import statistics
import time
from typing import Any, Final

from coincurve import PublicKey

from mesh.network import Channel, Endpoints, Network, free_endpoint
from messages import compact, route
from orders import ADDRESS, LIGHTHOUSE, signed_demands
from report import arguments, show
from schemas import Demand, Offer, Signer, encode

PING: Final = "aira/bench/ping"
CALLBACK_PING: Final = "aira/bench/callback/ping"
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
    """Seconds of each round trip, the kinds taken in turns."""
    taken: dict[str, list[float]] = {"bare": [], "callback": [], "verified": [], "signature": []}
    loop = asyncio.get_running_loop()
    async with (
        Network(Endpoints(connect=(endpoint,))) as network,
        Channel(network.session, LIGHTHOUSE, address=ADDRESS) as channel,
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
    """Seconds that one recovery takes here, between round trips, where nothing is warm."""
    signature, digest = compact(order)
    started = time.perf_counter()
    PublicKey.from_signature_and_message(signature, digest, hasher=None)
    return time.perf_counter() - started


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
    taken = asyncio.run(measure(endpoint, options.count))
    answering.terminate()
    router.terminate()
    median = {kind: statistics.median(seconds) for kind, seconds in taken.items()}
    figures = {
        "verified_ms": round(median["verified"] * 1e3, 3),
        "bare_ms": round(median["bare"] * 1e3, 3),
        "ratio": round(median["verified"] / median["bare"], 3),
        "signatures_ms": round(2 * median["signature"] * 1e3, 3),
        "ratio_without_signatures": round((median["verified"] - 2 * median["signature"]) / median["bare"], 3),
        "callback_ms": round(median["callback"] * 1e3, 3),
        "verified_p99_ms": round(statistics.quantiles(taken["verified"], n=100)[98] * 1e3, 3),
        "bare_p99_ms": round(statistics.quantiles(taken["bare"], n=100)[98] * 1e3, 3),
    }
    show(figures, as_json=options.json)


if __name__ == "__main__":
    main()
