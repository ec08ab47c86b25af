"""An honest result's way to IPFS while demands name files that nobody has: the flood `bridge-dead-cids`.

Router and bridge are processes of their own, as are two js-ipfs daemons, of which the second one listens. Measured is
the time from a result's publication on the mesh until the bridge's daemon has its file, before and after `count`
demands, each of a fresh key, are published at once. Bar: `BAR` seconds at most, and each honest file arrives.
"""

from __future__ import annotations

import asyncio
import secrets
import statistics
import sys
import tempfile
import time
from contextlib import AsyncExitStack, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from common import ADDRESS, LIGHTHOUSE, SPAWN, router, unsigned_demands

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # for the daemons of the tests

from bridges.ipfs import Daemon, IpfsError
from bridges.ipfs.service import IpfsBridge
from mesh.base.background import Background
from mesh.content import Exchange, Store
from mesh.network import Channel, Endpoints, Network
from mesh.settings import Settings
from mesh.watching import status_of
from schemas import Result, Signer, encode
from schemas.keys import market_selector
from schemas.status import BridgeStatus
from tests.support.ipfs import JsIpfs
from tests.support.waiting import until_found

if TYPE_CHECKING:
    from collections.abc import Sequence

COUNTS: Final = (160, 4300)
BEFORE, DURING = 8, 12
"""Honest results of each part."""
INTERVAL: Final = 1.5
"""Seconds between two honest results."""
PATIENCE: Final = 60.0
BAR: Final = 5.0
BRIDGE: Final = "0x" + "33" * 20
START: Final = 90.0


def run_bridge(endpoint: str, api: str, folder: str, ready: Any) -> None:
    """The bridge's process."""
    asyncio.run(_run_bridge(endpoint, api, folder, ready))


async def _run_bridge(endpoint: str, api: str, folder: str, ready: Any) -> None:
    settings = Settings(
        ipfs_http_provider=api,
        ipfs_gateway="",
        ipfs_public_providers=(),
        lighthouse_contract=LIGHTHOUSE,
        data_dir=folder,
    )
    async with (
        Network(Endpoints(connect=(endpoint,))) as network,
        IpfsBridge(network, settings, address=BRIDGE) as bridge,
    ):
        ready.set()
        await bridge.run()


@dataclass(kw_only=True)
class Robot:
    """An honest robot, and the bridge's daemon."""

    channel: Channel
    store: Store
    daemon: Daemon

    async def deliver(self) -> float:
        """Publish a result; the seconds until the daemon has its file, -1 if it never does."""
        content = secrets.token_bytes(1000)
        cid = await asyncio.to_thread(self.store.put_bytes, content)
        liability = "0x" + secrets.token_hex(20)
        result = Signer(secrets.token_bytes(32)).sign(Result(liability=liability, result=cid, success=True))
        self.channel.publish(result)
        began = time.monotonic()
        with suppress(IpfsError):  # the daemon waits for blocks that it lacks
            await self.daemon.block(cid, limit=1 << 20, timeout=PATIENCE)
            return time.monotonic() - began
        return -1.0

    async def deliver_some(self, number: int) -> list[float]:
        """Results at a steady pace, whatever becomes of them."""
        async with asyncio.TaskGroup() as tasks:
            delivering = []
            for _ in range(number):
                delivering.append(tasks.create_task(self.deliver()))
                await asyncio.sleep(INTERVAL)
        return [task.result() for task in delivering]


def _times(seconds: Sequence[float]) -> dict[str, float]:
    whole = [PATIENCE if each < 0 else each for each in seconds]
    lost = sum(each < 0 for each in seconds)
    return {
        "results": len(whole),
        "p50_s": round(statistics.median(whole), 2),
        "max_s": round(max(whole), 2),
        "lost": lost,
    }


async def measure(count: int) -> dict[str, Any]:
    """One flood of `count` demands."""
    async with AsyncExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        endpoint, _ = stack.enter_context(router())
        one, two = stack.enter_context(JsIpfs()), stack.enter_context(JsIpfs())
        here, there = [await stack.enter_async_context(Daemon(each.api)) for each in (one, two)]
        await here.detect_version()
        await here.connect(two.swarm_address)
        await stack.enter_async_context(there.subscribe(LIGHTHOUSE))
        ready = SPAWN.Event()
        process = SPAWN.Process(target=run_bridge, args=(endpoint, one.api, str(folder / "bridge"), ready), daemon=True)
        process.start()
        stack.callback(process.terminate)
        assert await asyncio.to_thread(ready.wait, START), "the bridge is not ready"
        networks = [await stack.enter_async_context(Network(Endpoints(connect=(endpoint,)))) for _ in range(2)]
        channel = await stack.enter_async_context(Channel(networks[0].session, LIGHTHOUSE))
        store = stack.enter_context(Store(folder / "robot"))
        await stack.enter_async_context(Exchange(networks[0].session, store))
        robot, session = Robot(channel=channel, store=store, daemon=here), networks[0].session

        async def status() -> BridgeStatus | None:
            return next((s for s in await status_of(session, BRIDGE, LIGHTHOUSE) if isinstance(s, BridgeStatus)), None)

        async def carries() -> bool:
            return (how := await status()) is not None and bool(how.carries and how.ipfs_peers)

        await until_found(carries, what="the bridge", seconds=START)
        demands = unsigned_demands(count, lighthouse=ADDRESS)
        wire = [encode(Signer(secrets.token_bytes(32)).sign(demand)) for demand in demands]
        before = await robot.deliver_some(BEFORE)
        async with Background() as tasks:
            tasks.start(_flood(networks[1], wire), "flood")
            during = await robot.deliver_some(DURING)
        how = await status()
        assert how is not None
        assert how.content is not None
        return _judged(count, _times(before), _times(during), how)


async def _flood(network: Network, wire: Sequence[bytes]) -> None:
    model = next(unsigned_demands(1)).model
    for number, payload in enumerate(wire):
        network.session.put(market_selector(LIGHTHOUSE, "demand", model), payload)
        if number % 64 == 0:
            await asyncio.sleep(0.01)


def _judged(count: int, before: dict[str, float], during: dict[str, float], how: BridgeStatus) -> dict[str, Any]:
    missed = [f"an honest result took {during['max_s']} s"] if during["max_s"] > BAR else []
    missed += [f"{during['lost']} honest results were lost"] if during["lost"] else []
    assert how.content is not None
    content = {name: getattr(how.content, name) for name in ("added", "failed", "adds_queued", "fetches_queued")}
    relay = {"carried": how.to_ipfs.carried, "waiting": how.to_ipfs.waiting, "dropped": dict(how.to_ipfs.dropped)}
    return {"demands": count, "before": before, "during": during, **content, **relay, "missed": missed}


async def measure_all() -> dict[str, Any]:
    """The flood with each of `COUNTS` demands."""
    found = [await measure(count) for count in COUNTS]
    return {"floods": found, "missed": [each for flood in found for each in flood["missed"]]}
