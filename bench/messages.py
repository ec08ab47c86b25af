"""Verified messages per second through a channel, compared with bare recoveries by coincurve in the same run.

Another process publishes signed demands through a router, never more at a time than Zenoh's queue holds, so that
none is lost. The receiving process runs on one core. Now and then it waits until all is verified, and recovers some
signatures alone, because the speed of a busy machine changes from second to second. Both rates are per second of its
processor time (of all its threads, including Zenoh's), in all `ROUNDS` together. The ratio is the share of that time
that recoveries take; the bar is `BAR`. Recovery, delivery, decoding and three Keccak hashes allow about 0.75. (From
Python 3.14 on, the recoveries are those of btclib-secp256k1.)
"""

from __future__ import annotations

import asyncio
import os
import sys
import threading
import time
from collections import deque
from statistics import fmean
from typing import TYPE_CHECKING, Any, Final

from zenoh import CongestionControl

from common import ADDRESS, LIGHTHOUSE, SPAWN, arguments, process, router, show, signed_demands
from mesh.network import Channel, Endpoints, MarketRules, Network, message_key
from schemas import Demand, encode, keccak256, message_hash

if TYPE_CHECKING:
    from collections.abc import Iterable

if sys.version_info >= (3, 14):
    from btclib_secp256k1.recovery import recover

    def recover_key(signature: bytes, digest: bytes) -> None:
        """One recovery by the library that the project uses, in the library's own way."""
        recover(digest, signature[:64], signature[64])
else:
    from coincurve import PublicKey

    def recover_key(signature: bytes, digest: bytes) -> None:
        """One recovery by the library that the project uses, in the library's own way."""
        PublicKey.from_signature_and_message(signature, digest, hasher=None)


WINDOW: Final = 1024
"""Most messages in flight; Zenoh's queue holds twice as many."""
ROUNDS: Final = 5
"""Measurements, each with a subscription of its own."""
BAR: Final = 0.70
"""The least ratio; the exit status is 1 below it."""
PROGRESS_KEY: Final = "aira/bench/progress"
EVERY: Final = 256
"""Messages between two progress reports of the receiver."""
INTERLUDE: Final = 2048
"""Messages between two measurements of bare recoveries."""
BARE: Final = 512
"""Recoveries in each of them."""
REST: Final = 0.05
"""Seconds in which the process must be idle before such a measurement."""
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


async def receive(endpoint: str, count: int, ready: Any) -> tuple[float, float]:
    """Seconds of this process's time for a verified message, and for a bare recovery."""
    received, latest, bare = 0, deque[Demand](maxlen=BARE), 0.0
    async with (
        Network(Endpoints(connect=(endpoint,))) as network,
        Channel(network.session, MarketRules(LIGHTHOUSE, address=ADDRESS)) as channel,
        channel.subscribe(Demand) as demands,
    ):
        await asyncio.sleep(0.5)  # the router learns of the subscription
        ready.set()
        await anext(demands)
        started, apart = time.process_time(), 0.0
        async for demand in demands:
            received += 1
            latest.append(demand.message)
            if received % EVERY == 0:
                network.session.put(PROGRESS_KEY, str(received + 1))
            if received % INTERLUDE == 0:
                before = rest()
                bare += recover_bare(latest)
                apart += time.process_time() - before
            if received == count - 1:
                network.session.put(PROGRESS_KEY, str(count))
                break
        seconds = time.process_time() - started - apart
        statistics = demands.statistics()
    assert not statistics.invalid, statistics
    assert not statistics.dropped, statistics
    return seconds / received, bare / (received // INTERLUDE * BARE)


def rest() -> float:
    """Block this thread until the pump has verified what it may; the process's time when the pump began to wait."""
    while True:
        before = time.process_time()
        time.sleep(REST)
        if time.process_time() - before < REST / 10:
            return before


def recover_bare(demands: Iterable[Demand]) -> float:
    """Seconds of this thread for recoveries of the same signatures; preparations are not counted."""
    signatures = [compact(demand) for demand in demands]
    started = time.thread_time()
    for signature, digest in signatures:
        recover_key(signature, digest)
    return time.thread_time() - started


def compact(demand: Demand) -> tuple[bytes, bytes]:
    """The signature as `recover_key` takes it, and the digest that was signed."""
    signature = bytes.fromhex(demand.signature)
    return signature[:64] + bytes([signature[64] - 27]), keccak256(PREFIX + message_hash(demand))


def main() -> None:
    """Run the benchmark."""
    options = arguments("verified messages per second, compared with bare recoveries", count=20_000)
    rounds = [measure(options.count) for _ in range(ROUNDS)]
    verified, bare = map(fmean, zip(*rounds, strict=True))
    results: dict[str, Any] = {"verified_per_second": round(1 / verified), "bare_per_second": round(1 / bare)}
    results |= {"ratio": round(bare / verified, 3), "bar": BAR}
    results["rounds"] = [round(bare / verified, 3) for verified, bare in rounds]
    show(results, as_json=options.json)
    sys.exit(bare / verified < BAR)


def measure(count: int) -> tuple[float, float]:
    """What `receive` returns, for a publisher and a router of its own."""
    ready, cores = SPAWN.Event(), os.sched_getaffinity(0)
    with router() as (endpoint, _), process(publish, endpoint, count, ready):
        os.sched_setaffinity(0, {min(cores)})
        try:
            return asyncio.run(receive(endpoint, count, ready))
        finally:
            os.sched_setaffinity(0, cores)


if __name__ == "__main__":
    main()
