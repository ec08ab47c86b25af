"""Messages over IPFS PubSub, over the bridge, and over Zenoh: how long one takes, how many pass, what is lost or twice.

`ipfs` is a bare client of one daemon publishing to a bare client of another, connected one: what the legacy network
did. `bridge` is a demand put on a Zenoh key that comes to a bare client of the second daemon. `zenoh` is the same
demand to a verified subscription. The daemons are js-ipfs, or with `--daemon kubo` those that `AIRA_KUBO` names; a Kubo
is given a message each 20 ms at most. Daemons and router are processes of their own. Latencies are of single messages,
one after the other; rates are of as many as are given without waiting.
"""

from __future__ import annotations

import asyncio
import multiprocessing
import statistics
import sys
import tempfile
import time
from collections import Counter
from contextlib import AsyncExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

ROOT: Final = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT))  # the daemons are those of the tests

from bridges.ipfs import ChannelBridge, Daemon, RelayJournal, RelayValidator  # noqa: E402
from mesh.background import Background  # noqa: E402
from mesh.network import Channel, Endpoints, Network, free_endpoint  # noqa: E402
from messages import route  # noqa: E402
from orders import ADDRESS, LIGHTHOUSE, signed_demands  # noqa: E402
from peers.catalog import PeerMissing, locate  # noqa: E402
from report import arguments, show  # noqa: E402
from schemas import Demand, encode  # noqa: E402
from tests.support.ipfs import JsIpfs, Kubo  # noqa: E402

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Sequence

    from tests.support.ipfs import IpfsDaemon

PATIENCE: Final = 15.0
"""Seconds without anything new after which what has not come is lost."""
WARM_UP: Final = 5
KINDS: Final[dict[str, type[IpfsDaemon]]] = {"js-ipfs": JsIpfs, "kubo": Kubo}
LOOKS: Final = 300
"""How often it is looked for a listener, a tenth of a second apart."""


class Ear:
    """Counts what is heard, by its bytes, and when the last of it came."""

    def __init__(self) -> None:
        self.heard: Counter[bytes] = Counter()
        self.last = 0.0
        self._news = asyncio.Event()

    def hear(self, data: bytes) -> None:
        """It was heard."""
        self.heard[data] += 1
        self.last = time.perf_counter()
        self._news.set()

    async def wait(self, *wanted: bytes) -> None:
        """Return when all that is wanted was heard, or nothing new for a while."""
        missing = {data for data in wanted if not self.heard[data]}
        while missing:
            self._news.clear()
            try:
                await asyncio.wait_for(self._news.wait(), PATIENCE)
            except TimeoutError:
                return
            missing = {data for data in missing if not self.heard[data]}


async def measure(say: Callable[[Demand], Awaitable[None]], ear: Ear, orders: Sequence[Demand]) -> dict[str, float]:
    """The figures of one way: half of the orders one after the other, the others without waiting."""
    wanted = {order.nonce: encode(order) for order in orders}
    half = len(orders) // 2
    taken = []
    for order in orders[:half]:
        started = time.perf_counter()
        await say(order)
        await ear.wait(wanted[order.nonce])
        taken.append(time.perf_counter() - started)
    started = time.perf_counter()
    for order in orders[half:]:
        await say(order)
    await ear.wait(*(wanted[order.nonce] for order in orders[half:]))
    seconds = ear.last - started
    counts = [ear.heard[data] for data in wanted.values()]
    return {
        "p50_ms": round(statistics.median(taken[WARM_UP:]) * 1e3, 3),
        "p99_ms": round(statistics.quantiles(taken[WARM_UP:], n=100)[98] * 1e3, 3),
        "per_second": round((len(orders) - half) / seconds, 1),
        "lost": counts.count(0),
        "twice": sum(count > 1 for count in counts),
    }


async def listen(daemon: Daemon, topic: str, ear: Ear, ready: asyncio.Event) -> None:
    """Hear a topic; a message counts in the mesh's own writing, whatever the order of its fields."""
    from schemas import decode

    async with daemon.subscribe(topic) as events:
        ready.set()
        async for event in events:
            if event is not None:
                ear.hear(encode(decode(event.data)))


async def heard_by(daemon: Daemon, topic: str) -> None:
    """Return when the daemon knows a listener, and its swarm has had a heartbeat to pass messages on."""
    for _ in range(LOOKS):
        if await daemon.listeners(topic):
            break
        await asyncio.sleep(0.1)
    await asyncio.sleep(2)


async def over_ipfs(here: Daemon, there: Daemon, orders: Sequence[Demand]) -> dict[str, float]:
    """From a bare client of one daemon to one of another."""
    topic, ear, ready = "bench.lighthouse.3.robonomics.eth", Ear(), asyncio.Event()
    async with Background() as tasks:
        tasks.start(listen(there, topic, ear, ready), "listens")
        await ready.wait()
        await heard_by(here, topic)
        return await measure(lambda order: here.publish(topic, encode(order)), ear, orders)


async def over_bridge(
    endpoint: str, here: Daemon, there: Daemon, orders: Sequence[Demand], folder: Path
) -> dict[str, float]:
    """From a Zenoh key to a bare client of the other daemon."""
    ear, ready = Ear(), asyncio.Event()
    async with AsyncExitStack() as stack:
        network = await stack.enter_async_context(Network(Endpoints(connect=(endpoint,))))
        person = await stack.enter_async_context(Network(Endpoints(connect=(endpoint,))))
        channel = await stack.enter_async_context(Channel(person.session, LIGHTHOUSE, address=ADDRESS))
        journal = stack.enter_context(RelayJournal(folder / "journal.sqlite"))
        bridge = ChannelBridge(
            network, here, RelayValidator(LIGHTHOUSE, address=lambda: ADDRESS), journal, lighthouse=LIGHTHOUSE
        )
        await stack.enter_async_context(bridge)
        tasks = await stack.enter_async_context(Background())
        tasks.start(listen(there, LIGHTHOUSE, ear, ready), "listens")
        tasks.start(bridge.run(), "bridge")
        await ready.wait()
        await heard_by(here, LIGHTHOUSE)
        return await measure(publishing(channel), ear, orders)


async def over_zenoh(endpoint: str, orders: Sequence[Demand]) -> dict[str, float]:
    """From a Zenoh key to a verified subscription."""
    ear = Ear()
    async with (
        Network(Endpoints(connect=(endpoint,))) as network,
        Network(Endpoints(connect=(endpoint,))) as person,
        Channel(network.session, LIGHTHOUSE, address=ADDRESS) as there,
        Channel(person.session, LIGHTHOUSE, address=ADDRESS) as here,
        there.subscribe(Demand) as demands,
        Background() as tasks,
    ):

        async def hear() -> None:
            async for demand in demands:
                ear.hear(encode(demand.message))

        tasks.start(hear(), "hears")
        await asyncio.sleep(0.5)  # the router learns of the subscription
        return await measure(publishing(here), ear, orders)


def publishing(channel: Channel) -> Callable[[Demand], Awaitable[None]]:
    """How an order is said on the mesh."""

    async def say(order: Demand) -> None:
        channel.publish(order)
        await asyncio.sleep(0)

    return say


async def measure_all(endpoint: str, one: IpfsDaemon, two: IpfsDaemon, count: int) -> dict[str, Any]:
    """All three ways."""
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
    """Run it."""
    options = arguments("messages over IPFS PubSub, the bridge and Zenoh", count=1000, daemon=tuple(KINDS))
    try:
        locate(options.daemon)
    except PeerMissing as missing:
        sys.exit(str(missing))
    kind = KINDS[options.daemon]
    endpoint = free_endpoint()
    router = multiprocessing.get_context("spawn").Process(target=route, args=(endpoint,), daemon=True)
    router.start()
    with kind() as one, kind() as two:
        figures = asyncio.run(measure_all(endpoint, one, two, options.count))
    router.terminate()
    show(figures, as_json=options.json)


if __name__ == "__main__":
    main()
