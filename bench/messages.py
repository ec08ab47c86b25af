"""Verified messages per second through a channel, compared with bare coincurve recoveries in the same run.

Another process publishes signed demands through a router, never more at a time than the channel's ring holds, so that
none is lost. The receiving process runs on one core. Both rates are per second of its processor time (of all its
threads, including Zenoh's), so that other load on the machine does not count. The ratio is the share of that time that
recoveries take.
"""

from __future__ import annotations

import asyncio
import os
import threading
import time
from typing import Any, Final

from coincurve import PublicKey
from zenoh import CongestionControl

from common import ADDRESS, LIGHTHOUSE, SPAWN, arguments, router, show, signed_demands
from mesh.network import Channel, Endpoints, Network, message_key
from schemas import Demand, encode, keccak256, message_hash

WINDOW: Final = 4096
"""Most messages in flight; the ring holds twice as many."""
PROGRESS_KEY: Final = "aira/bench/progress"
EVERY: Final = 256
"""Messages between two progress reports of the receiver."""
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

    block = CongestionControl.BLOCK  # a full queue must slow the publisher down, not drop messages
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
    """Verified messages per second of this process's time, and the messages."""
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
    """Recoveries of the same signatures per second of this process's time; preparations are not counted."""
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
    """Run the benchmark."""
    options = arguments("verified messages per second, compared with bare recoveries", count=20_000)
    ready, core = SPAWN.Event(), min(os.sched_getaffinity(0))
    with router() as (endpoint, _):
        publisher = SPAWN.Process(target=publish, args=(endpoint, options.count, ready))
        publisher.start()
        os.sched_setaffinity(0, {core})
        rate, demands = asyncio.run(receive(endpoint, options.count, ready))
        publisher.join()
    bare = recover_bare(demands)
    results = {"verified_per_second": round(rate), "bare_per_second": round(bare), "ratio": round(rate / bare, 3)}
    show(results, as_json=options.json)


if __name__ == "__main__":
    main()
