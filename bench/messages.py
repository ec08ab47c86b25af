"""Verified messages a second through the channel, against bare coincurve recoveries in the same run.

A process of its own publishes signed demands through a router and keeps no more under way than the channel's ring
holds, so nothing is lost. The receiving process is held to one core, and what counts is its own processor time (all of
its threads, Zenoh's too), for the channel and for the bare recoveries alike: the ratio is what is left of a core's
recoveries when all the rest of the work is done as well, whatever else the machine does.
"""

from __future__ import annotations

import asyncio
import multiprocessing
import os
import threading
import time
from typing import Any, Final

from coincurve import PublicKey
from zenoh import CongestionControl

from mesh.network import Channel, Endpoints, Network, free_endpoint, message_key
from orders import ADDRESS, LIGHTHOUSE, signed_demands
from report import arguments, show
from schemas import Demand, encode, keccak256, message_hash

WINDOW: Final = 4096
"""Messages under way at most; the ring holds twice as many."""
PROGRESS_KEY: Final = "aira/bench/progress"
EVERY: Final = 256
"""Messages after which the receiver says how far it is."""
PREFIX: Final = b"\x19Ethereum Signed Message:\n32"


def publish(endpoint: str, count: int, ready: Any) -> None:
    """The publishing process."""
    asyncio.run(_publish(endpoint, count, ready))


async def _publish(endpoint: str, count: int, ready: Any) -> None:
    demands = signed_demands(count)
    done, room = 0, threading.Event()

    def progressed(sample: Any) -> None:
        nonlocal done
        done = int(sample.payload.to_string())
        room.set()

    block = CongestionControl.BLOCK  # a full queue must slow the flood down, not thin it out
    wire = [(message_key(LIGHTHOUSE, demand), encode(demand)) for demand in demands]
    async with Network(Endpoints(connect=(endpoint,))) as network:
        network.session.declare_subscriber(PROGRESS_KEY, progressed)
        ready.wait()
        for number, (key, payload) in enumerate(wire):
            while number - done >= WINDOW:
                room.clear()
                await asyncio.to_thread(room.wait, 1)
            network.session.put(key, payload, congestion_control=block)
        while done < count:
            room.clear()
            await asyncio.to_thread(room.wait, 1)


async def receive(endpoint: str, count: int, ready: Any) -> tuple[float, list[Demand]]:
    """Verified messages a second of this process's time, and the messages."""
    received: list[Demand] = []
    async with (
        Network(Endpoints(connect=(endpoint,))) as network,
        Channel(network.session, LIGHTHOUSE, address=ADDRESS) as channel,
        channel.subscribe(Demand) as demands,
    ):
        await asyncio.sleep(0.5)  # the router learns of the subscription
        ready.set()
        await anext(demands)
        started = time.process_time()
        async for demand in demands:
            received.append(demand.message)
            if len(received) % EVERY == 0 or len(received) == count - 1:
                network.session.put(PROGRESS_KEY, str(len(received) + 1))
            if len(received) == count - 1:
                break
        seconds = time.process_time() - started
        statistics = demands.statistics()
    assert not statistics.invalid, statistics
    assert not statistics.dropped, statistics
    return len(received) / seconds, received


def recover_bare(demands: list[Demand]) -> float:
    """Recoveries a second of this process's time, of the same signatures; the rest is done beforehand."""
    signatures = [compact(demand) for demand in demands]
    started = time.process_time()
    for signature, digest in signatures:
        PublicKey.from_signature_and_message(signature, digest, hasher=None)
    return len(signatures) / (time.process_time() - started)


def compact(demand: Demand) -> tuple[bytes, bytes]:
    """The signature as coincurve takes it, and the digest that was signed."""
    signature = bytes.fromhex(demand.signature)
    return signature[:64] + bytes([signature[64] - 27]), keccak256(PREFIX + message_hash(demand))


def main() -> None:
    """Run it."""
    options = arguments("verified messages a second against bare recoveries", count=20_000)
    spawn = multiprocessing.get_context("spawn")
    endpoint, ready = free_endpoint(), spawn.Event()
    cores = sorted(os.sched_getaffinity(0))
    router = spawn.Process(target=route, args=(endpoint,), daemon=True)
    router.start()
    publisher = spawn.Process(target=publish, args=(endpoint, options.count, ready))
    publisher.start()
    os.sched_setaffinity(0, {cores[0]})
    rate, demands = asyncio.run(receive(endpoint, options.count, ready))
    publisher.join()
    router.terminate()
    bare = recover_bare(demands)
    figures = {"verified_per_second": round(rate), "bare_per_second": round(bare), "ratio": round(rate / bare, 3)}
    show(figures, as_json=options.json)


def route(endpoint: str) -> None:
    """The router's process."""
    asyncio.run(_route(endpoint))


async def _route(endpoint: str) -> None:
    async with Network(Endpoints(listen=(endpoint,), mode="router")):
        await asyncio.Event().wait()


if __name__ == "__main__":
    main()
