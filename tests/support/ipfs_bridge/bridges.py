"""Bridges for tests, with their network, daemon and journal."""

from __future__ import annotations

import asyncio
from contextlib import AsyncExitStack, asynccontextmanager
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from bridges.ipfs import BridgeParts, ChannelBridge, Daemon, RelayJournal, RelayValidator
from bridges.ipfs.daemon import DAEMON_LIMITS
from mesh.base.background import Background
from mesh.base.flood import Drops
from mesh.network import Channel, Endpoints, MarketRules, Network, Pump
from schemas.status import BridgeStatus, bridge_status_key
from tests.support.orders import LIGHTHOUSE
from tests.support.waiting import until_found

if TYPE_CHECKING:
    from collections.abc import AsyncIterator
    from pathlib import Path

    import zenoh

    from mesh.market.store import Withdrawals
    from schemas import Signer


@asynccontextmanager
async def bridging(
    endpoint: str,
    api: str,
    topic: str,
    journal: Path,
    *,
    call_timeout: float = DAEMON_LIMITS.call,
    withdrawals: Withdrawals | None = None,
    drops: Drops | None = None,
    signer: Signer | None = None,
    **options: Any,
) -> AsyncIterator[ChannelBridge]:
    """A running bridge between the router at `endpoint` and the daemon at `api`."""
    async with AsyncExitStack() as stack:
        network = await stack.enter_async_context(Network(Endpoints(connect=(endpoint,))))
        daemon = await stack.enter_async_context(Daemon(api, call_timeout=call_timeout))
        parts = BridgeParts(
            network=network,
            daemon=daemon,
            validator=RelayValidator(MarketRules(topic, address=LIGHTHOUSE), withdrawals=withdrawals),
            journal=stack.enter_context(RelayJournal(journal)),
            drops=drops or Drops(),
            signer=signer,
        )
        bridge = ChannelBridge(parts, **options)
        await stack.enter_async_context(bridge)
        tasks = await stack.enter_async_context(Background())
        tasks.start(bridge.run(), "bridge of the test")
        yield bridge


@dataclass
class Mesh:
    """A client on the mesh: `heard` is every sample received, with its key, duplicates included."""

    network: Network
    channel: Channel
    heard: list[tuple[str, bytes]] = field(default_factory=list)

    @property
    def payloads(self) -> list[bytes]:
        """The payloads received, without the keys."""
        return [payload for _, payload in self.heard]


@asynccontextmanager
async def on_mesh(endpoint: str, topic: str) -> AsyncIterator[Mesh]:
    """A client of the router that receives everything on a market."""

    def read(sample: zenoh.Sample) -> tuple[str, bytes]:
        return str(sample.key_expr), sample.payload.to_bytes()

    async with (
        Network(Endpoints(connect=(endpoint,))) as network,
        Channel(network.session, MarketRules(topic, address=LIGHTHOUSE)) as channel,
        Pump(network.session, f"aira/{topic}/**", read) as pump,
        Background() as tasks,
    ):
        mesh = Mesh(network, channel)

        async def listen() -> None:
            async for heard in pump:
                mesh.heard.append(heard)

        tasks.start(listen(), "hears the mesh")
        yield mesh


async def status_of_the_bridge(session: zenoh.Session, topic: str) -> BridgeStatus:
    """What the only bridge of a market replies for its status."""
    nobody = "0x" + "0" * 40
    key = bridge_status_key(nobody, topic).replace(nobody, "*")

    async def answers() -> list[zenoh.Sample]:
        replies = await asyncio.to_thread(lambda: list(session.get(key, timeout=30.0)))
        return [reply.ok for reply in replies if reply.ok is not None]

    (reply,) = await until_found(answers, what="the bridge's status")  # it is declared after the bridge's token
    status = BridgeStatus.decode(reply.payload.to_bytes())
    assert str(reply.key_expr) == bridge_status_key(status.bridge, topic)
    return status


async def until_seen(mesh: Mesh, *addresses: str) -> None:
    """Return when these bridges (or any one) are present, after which they receive published messages."""

    async def are_there() -> bool:
        present = {key.agent for key in await mesh.channel.present() if key.role == "bridge"}
        return bool(present) and present.issuperset(addresses)

    await until_found(are_there, what="the bridge's token", seconds=60)
