"""Messages over IPFS PubSub, over the bridge, and over Zenoh: latency, rate, losses and duplicates.

`ipfs`: a bare client of one daemon publishes to a bare client of a connected daemon, as on the legacy network.
`bridge`: a demand on a Zenoh key reaches a bare client of the second daemon. `zenoh`: the same demand reaches a
verified subscription. The daemons are js-ipfs, or with `--daemon kubo` a current Kubo; a Kubo gets at
most one message every 20 ms, and those pauses are not measured. Daemons and router run in processes of their own.
Latencies are measured one message at a time, rates without waiting between messages.
"""

from __future__ import annotations

import asyncio
import statistics
import sys
import tempfile
import time
from collections import Counter
from contextlib import AsyncExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

ROOT: Final = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT))  # for the daemons of the tests

from bridges.ipfs import BridgeParts, ChannelBridge, Daemon, RelayJournal, RelayValidator  # noqa: E402
from bridges.ipfs.daemon import DAEMON_LIMITS  # noqa: E402
from common import ADDRESS, LIGHTHOUSE, arguments, router, show, signed_demands  # noqa: E402
from mesh.base.background import Background  # noqa: E402
from mesh.network import Channel, Endpoints, MarketRules, Network  # noqa: E402
from peers.catalog import PeerMissing, locate  # noqa: E402
from schemas import Demand, encode  # noqa: E402
from tests.support.ipfs import JsIpfs, Kubo  # noqa: E402

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Sequence

    from tests.support.ipfs import IpfsDaemon

TIMEOUT: Final = 15.0
"""Seconds without a new message after which the missing ones count as lost."""
WARM_UP: Final = 5
KINDS: Final[dict[str, type[IpfsDaemon]]] = {"js-ipfs": JsIpfs, "kubo": Kubo}
CHECKS: Final = 300
"""Checks for a listener, a tenth of a second apart."""


class Receiver:
    """Counts received messages by their bytes, and remembers when the last one arrived."""

    def __init__(self) -> None:
        self.counts: Counter[bytes] = Counter()
        self.last = 0.0
        self._arrived = asyncio.Event()

    def receive(self, data: bytes) -> None:
        """Count a message."""
        self.counts[data] += 1
        self.last = time.perf_counter()
        self._arrived.set()

    async def wait(self, *wanted: bytes) -> None:
        """Wait until all these messages have arrived, or none for `TIMEOUT` seconds."""
        missing = {data for data in wanted if not self.counts[data]}
        while missing:
            self._arrived.clear()
            try:
                await asyncio.wait_for(self._arrived.wait(), TIMEOUT)
            except TimeoutError:
                return
            missing = {data for data in missing if not self.counts[data]}


async def measure(
    publish: Callable[[Demand], Awaitable[None]], receiver: Receiver, orders: Sequence[Demand], pause: float = 0.0
) -> dict[str, float]:
    """The results of one path: half of the orders one at a time, the others without waiting.

    `pause` is in seconds, the least time between two messages to the daemon: it is waited for before the measurement of
    each latency. A rate would only show the pause, so there is none then.
    """
    wanted = {order.nonce: encode(order) for order in orders}
    half = len(orders) // 2
    taken = []
    for order in orders[:half]:
        await asyncio.sleep(pause)
        started = time.perf_counter()
        await publish(order)
        await receiver.wait(wanted[order.nonce])
        taken.append(time.perf_counter() - started)
    started = time.perf_counter()
    for order in orders[half:]:
        await publish(order)
    await receiver.wait(*(wanted[order.nonce] for order in orders[half:]))
    seconds = receiver.last - started
    counts = [receiver.counts[data] for data in wanted.values()]
    return {
        "p50_ms": round(statistics.median(taken[WARM_UP:]) * 1e3, 3),
        "p99_ms": round(statistics.quantiles(taken[WARM_UP:], n=100)[98] * 1e3, 3),
        **({} if pause else {"per_second": round((len(orders) - half) / seconds, 1)}),
        "lost": counts.count(0),
        "twice": sum(count > 1 for count in counts),
    }


async def listen(daemon: Daemon, topic: str, receiver: Receiver, ready: asyncio.Event) -> None:
    """Receive a topic. Messages are encoded again, as the order of fields may differ."""
    from schemas import decode

    async with daemon.subscribe(topic) as events:
        ready.set()
        async for event in events:
            if event is not None:
                receiver.receive(encode(decode(event.data)))


async def until_listened(daemon: Daemon, topic: str) -> None:
    """Wait until the daemon knows a listener, and until its swarm has had a heartbeat."""
    for _ in range(CHECKS):
        if await daemon.listeners(topic):
            break
        await asyncio.sleep(0.1)
    await asyncio.sleep(2)


def pause_of(daemon: Daemon) -> float:
    """Seconds that a daemon needs between two messages."""
    return 0.0 if daemon.version is None or daemon.version.is_js else DAEMON_LIMITS.publish


async def over_ipfs(here: Daemon, there: Daemon, orders: Sequence[Demand]) -> dict[str, float]:
    """From a bare client of one daemon to one of another."""
    topic, receiver, ready = "bench.lighthouse.3.robonomics.eth", Receiver(), asyncio.Event()
    async with Background() as tasks:
        tasks.start(listen(there, topic, receiver, ready), "receiver")
        await ready.wait()
        await until_listened(here, topic)
        return await measure(lambda order: here.publish(topic, encode(order)), receiver, orders, pause_of(here))


async def over_bridge(
    endpoint: str, here: Daemon, there: Daemon, orders: Sequence[Demand], folder: Path
) -> dict[str, float]:
    """From a Zenoh key to a bare client of the other daemon."""
    receiver, ready = Receiver(), asyncio.Event()
    async with AsyncExitStack() as stack:
        network = await stack.enter_async_context(Network(Endpoints(connect=(endpoint,))))
        person = await stack.enter_async_context(Network(Endpoints(connect=(endpoint,))))
        channel = await stack.enter_async_context(Channel(person.session, MarketRules(LIGHTHOUSE, address=ADDRESS)))
        parts = BridgeParts(
            network=network,
            daemon=here,
            validator=RelayValidator(MarketRules(LIGHTHOUSE, address=ADDRESS)),
            journal=stack.enter_context(RelayJournal(folder / "journal.sqlite")),
        )
        bridge = ChannelBridge(parts)
        await stack.enter_async_context(bridge)
        tasks = await stack.enter_async_context(Background())
        tasks.start(listen(there, LIGHTHOUSE, receiver, ready), "receiver")
        tasks.start(bridge.run(), "bridge")
        await ready.wait()
        await until_listened(here, LIGHTHOUSE)
        return await measure(publishing(channel), receiver, orders, pause_of(here))


async def over_zenoh(endpoint: str, orders: Sequence[Demand]) -> dict[str, float]:
    """From a Zenoh key to a verified subscription."""
    receiver = Receiver()
    async with (
        Network(Endpoints(connect=(endpoint,))) as network,
        Network(Endpoints(connect=(endpoint,))) as person,
        Channel(network.session, MarketRules(LIGHTHOUSE, address=ADDRESS)) as there,
        Channel(person.session, MarketRules(LIGHTHOUSE, address=ADDRESS)) as here,
        there.subscribe(Demand) as demands,
        Background() as tasks,
    ):

        async def receive() -> None:
            async for demand in demands:
                receiver.receive(encode(demand.message))

        tasks.start(receive(), "receiver")
        await asyncio.sleep(0.5)  # the router learns of the subscription
        return await measure(publishing(here), receiver, orders)


def publishing(channel: Channel) -> Callable[[Demand], Awaitable[None]]:
    """A function that publishes an order on the mesh."""

    async def publish(order: Demand) -> None:
        channel.publish(order)
        await asyncio.sleep(0)

    return publish


async def measure_all(endpoint: str, one: IpfsDaemon, two: IpfsDaemon, count: int) -> dict[str, Any]:
    """All three paths."""
    async with Daemon(one.api) as here, Daemon(two.api) as there:
        for daemon in (here, there):
            await daemon.detect_version()
        await here.connect(two.swarm_address)
        with tempfile.TemporaryDirectory() as folder:
            return {
                "ipfs": await over_ipfs(here, there, signed_demands(count)),
                "bridge": await over_bridge(endpoint, here, there, signed_demands(count), Path(folder)),
                "zenoh": await over_zenoh(endpoint, signed_demands(count)),
            }


def main() -> None:
    """Run the benchmark."""
    options = arguments("messages over IPFS PubSub, the bridge and Zenoh", count=1000, daemon=tuple(KINDS))
    try:
        locate(options.daemon)
    except PeerMissing as missing:
        sys.exit(str(missing))
    kind = KINDS[options.daemon]
    with router() as (endpoint, _), kind() as one, kind() as two:
        results = asyncio.run(measure_all(endpoint, one, two, options.count))
    show(results, as_json=options.json)


if __name__ == "__main__":
    main()
