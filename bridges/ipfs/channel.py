"""The bridge of one lighthouse between its keys on the mesh and its topic on IPFS."""

from __future__ import annotations

import asyncio
import logging
import re
import secrets
import time
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import zenoh

from bridges.ipfs.daemon_link import RECONNECT, DaemonLink
from bridges.ipfs.journal import Side
from bridges.ipfs.presence import BridgePresence
from bridges.ipfs.publishers import BRIDGE_MARK, PUBLISH_RETRY, IpfsPublisher, MeshPublisher
from bridges.ipfs.relay import QUEUE_LIMIT, MessageRelay, RelayOutcome
from bridges.ipfs.status import BridgeHealth, changes_between, counters_of
from mesh.background import call_in_loop
from mesh.errors import InvalidMessage
from mesh.flood import Drops
from mesh.log_context import log_event
from mesh.network import Channel, NetworkChange, Pump
from mesh.role import Role
from schemas import Withdrawal, lighthouse_selector
from schemas.keys import market_kind
from schemas.status import BridgeStatus, bridge_status_key

if TYPE_CHECKING:
    from collections.abc import Callable
    from contextlib import AsyncExitStack

    from bridges.ipfs.daemon import Daemon
    from bridges.ipfs.journal import RelayJournal
    from bridges.ipfs.pubsub import PubsubMessage
    from bridges.ipfs.validation import RelayMessage, RelayValidator
    from mesh.market.withdrawals import Withdrawals
    from mesh.network import Network
    from mesh.retry import RetryPolicy
    from schemas.status import ContentMetrics

log = logging.getLogger(__name__)

OVERDUE_INTERVAL: Final = 1.0
"""Seconds between two checks of messages left to other bridges."""
REPORT_INTERVAL: Final = 60.0
"""Seconds between two log events with the counters."""
SLICE: Final = 16
"""Messages of the mesh that are received before the event loop does something else: a few milliseconds."""
LOOKUP_LIMIT: Final = 256
"""Messages that may wait for the resolution of their ENS names."""
_ENS_NAME: Final = re.compile(rb"\.(?:eth|sid|test)\"", re.IGNORECASE)
"""Occurs in every message that contains an ENS name."""


class MeshMessage(NamedTuple):
    """A message received on the mesh; `by_bridge` if a bridge put it there."""

    key: str
    payload: bytes
    by_bridge: bool


class ChannelBridge(Role):
    """Relays messages both ways: `async with ChannelBridge(...) as bridge`, then `run`.

    `validator` checks the messages of `lighthouse` (ENS name); `journal` belongs to this bridge alone; `swarm_peers`
    are multiaddrs to which the daemon is kept connected; `address` identifies the bridge on the mesh, by default a
    random one; `limit` bounds the queue of each direction; `published` is called with each message that this bridge
    sent; `content` returns metrics for the status, and `drops` has what is dropped. Changed counters are logged every
    `report_interval` seconds. `reconnect` and `publish_retry` are the delays after failures of the daemon. The caller
    closes network, daemon and journal.

    An accepted message waits in the journal, even if `run` is cancelled, until the daemon has accepted it and names a
    listener. If the daemon dies during a call, the message may have gone out and is published again. What the daemon or
    other nodes lose after that is lost until its sender repeats it: then it is relayed again (`journal.REPETITION`).
    """

    title = "bridge"

    def __init__(
        self,
        network: Network,
        daemon: Daemon,
        validator: RelayValidator,
        journal: RelayJournal,
        *,
        lighthouse: str,
        swarm_peers: tuple[str, ...] = (),
        address: str | None = None,
        limit: int = QUEUE_LIMIT,
        published: Callable[[Side, RelayMessage], None] = lambda side, message: None,
        content: Callable[[], ContentMetrics | None] = lambda: None,
        drops: Drops | None = None,
        report_interval: float = REPORT_INTERVAL,
        reconnect: RetryPolicy = RECONNECT,
        publish_retry: RetryPolicy = PUBLISH_RETRY,
    ) -> None:
        self.lighthouse: Final = lighthouse.lower()
        self.address: Final = (address or f"0x{secrets.token_hex(20)}").lower()
        self._network = network
        self._daemon = daemon
        self._validator = validator
        self._journal = journal
        self.link: Final = DaemonLink(daemon, self.lighthouse, swarm_peers=swarm_peers, retry=reconnect)
        self.relay: Final = MessageRelay(time.monotonic, journal, limit=limit)
        self._to_ipfs = IpfsPublisher(self.link, self.relay, published, publish_retry)
        self._to_mesh = MeshPublisher(network, self.relay, published)
        self._content = content
        self._drops = Drops() if drops is None else drops
        self._report_interval = report_interval
        self._started = time.monotonic()
        self._lookups = asyncio.Semaphore(LOOKUP_LIMIT)

    async def _open(self, stack: AsyncExitStack) -> None:
        session = self._network.session
        channel = await stack.enter_async_context(
            Channel(session, self.lighthouse, head=self._validator.head, drops=self._drops)
        )
        self._withdrawn = await stack.enter_async_context(channel.subscribe(Withdrawal))
        self._pump: Pump[MeshMessage] = await stack.enter_async_context(
            Pump(session, lighthouse_selector(self.lighthouse), _convert)
        )
        # After the subscription: once its token is seen, the bridge receives what is published.
        self._presence = await stack.enter_async_context(
            BridgePresence(session, self.lighthouse, self.address, self.relay, wake=self._wake)
        )
        loop = asyncio.get_running_loop()
        queryable: Any = session.declare_queryable(
            bridge_status_key(self.address, self.lighthouse), lambda query: call_in_loop(loop, self._answer, query)
        )
        stack.callback(lambda: None if session.is_closed() else queryable.undeclare())
        self.relay.restore()
        self._wake()

    async def _work(self) -> None:
        async with asyncio.TaskGroup() as tasks:
            self._tasks = tasks
            tasks.create_task(self._take_withdrawals(), name=f"withdrawals at {self.lighthouse}")
            tasks.create_task(self._recall_withdrawals(), name=f"known withdrawals at {self.lighthouse}")
            tasks.create_task(self._receive_from_mesh(), name=f"mesh → bridge {self.lighthouse}")
            tasks.create_task(
                self.link.run(self._receive_from_ipfs, self._link_changed), name=f"IPFS → {self.lighthouse}"
            )
            tasks.create_task(self._to_ipfs.run(), name=f"bridge → IPFS {self.lighthouse}")
            tasks.create_task(self._to_mesh.run(), name=f"bridge → mesh {self.lighthouse}")
            tasks.create_task(self._take_overdue(), name=f"overdue messages {self.lighthouse}")
            tasks.create_task(self._report(), name=f"report of {self.lighthouse}")

    def status(self) -> BridgeStatus:
        """The bridge's current status."""
        return BridgeStatus(
            bridge=self.address,
            lighthouse=self.lighthouse,
            state=self._state(),
            carries=self.relay.is_active,
            api=self._daemon.api,
            daemon=str(self._daemon.version or ""),
            dialect=self._daemon.dialect,
            ipfs_peers=self.link.listeners,
            mesh_peers=tuple(sorted(f"{key.role} {key.agent}" for key in self._presence.present)),
            losses=self.link.losses,
            last_error=self.link.error,
            to_ipfs=self.relay.status(Side.IPFS, per_second=self._to_ipfs.rate.per_second()),
            to_mesh=self.relay.status(Side.MESH, per_second=self._to_mesh.rate.per_second()),
            content=self._content(),
            uptime=round(time.monotonic() - self._started, 1),
            dropped=self._drops.totals(),
            heaviest=self._drops.senders(),
        )

    def health(self) -> BridgeHealth:
        """The status, and whether the router and the daemon are connected."""
        return BridgeHealth(self.status(), routed=self._network.connected, subscribed=self.link.up)

    def _state(self) -> str:
        if not self._network.connected:
            return "no router"
        if not self.link.up:
            return "no daemon"
        return "connected" if self.link.listeners else "alone"

    @property
    def withdrawals(self) -> Withdrawals:
        """The withdrawals that are known; the orders that they concern are not relayed."""
        return self._validator.withdrawals

    async def _take_withdrawals(self) -> None:
        async for withdrawal in self._withdrawn:
            self.withdrawals.expire(self._validator.head())
            if self.withdrawals.add(withdrawal):
                self.relay.drop_withdrawn(withdrawal.message.order, self._validator.is_withdrawn)
            else:
                self._withdrawn.forget(withdrawal)

    async def _recall_withdrawals(self) -> None:
        """Ask the providers for the withdrawals that they know, now and whenever a router is back."""
        await self._withdrawn.recall()
        async for change in self._network.changes():
            if change is not NetworkChange.LOST:
                await self._withdrawn.recall()

    async def _receive_from_mesh(self) -> None:
        dropped = number = 0
        async for message in self._pump:
            number += 1
            if number % SLICE == 0:
                await asyncio.sleep(0)  # others publish meanwhile
            if (lost := self._pump.dropped - dropped) > 0:
                dropped += lost
                self.relay.dropped[Side.IPFS]["unseen"] += lost
            await self._receive(message.payload, Side.MESH, key=message.key, by_bridge=message.by_bridge)

    async def _receive_from_ipfs(self, message: PubsubMessage | None) -> None:
        if message is None:
            self._reject(Side.IPFS, InvalidMessage("line", "unreadable line from the daemon"))
        else:
            await self._receive(message.data, Side.IPFS, echo=message.sender == self.link.identity)

    async def _receive(
        self, payload: bytes, side: Side, *, key: str | None = None, echo: bool = False, by_bridge: bool = False
    ) -> None:
        self.relay.counts[side.other]["received"] += 1
        if not _ENS_NAME.search(payload):
            await self._accept(payload, side, key=key, echo=echo, by_bridge=by_bridge)
        elif self._lookups.locked():
            self._reject(side, InvalidMessage("name", "too many messages wait for the resolution of names"))
        else:  # later messages may overtake this one
            await self._lookups.acquire()
            lookup = self._accept(payload, side, key=key, echo=echo, by_bridge=by_bridge)
            task = self._tasks.create_task(lookup, name="resolve names of a message")
            task.add_done_callback(lambda _: self._lookups.release())

    async def _accept(self, payload: bytes, side: Side, *, key: str | None, echo: bool, by_bridge: bool) -> None:
        try:
            message = await self._validator.validate(payload, key=key)
        except InvalidMessage as error:
            self._reject(side, error)
            return
        if self.relay.receive(message, side, echo=echo, by_bridge=by_bridge) is RelayOutcome.ACCEPTED:
            self._wake()

    def _reject(self, side: Side, error: InvalidMessage) -> None:
        self.relay.invalid[side.other][error.reason] += 1
        log.debug("%s: rejected a message from %s: %s", self.lighthouse, side.value, error)

    def _wake(self) -> None:
        self._to_ipfs.wake()
        self._to_mesh.wake()

    async def _take_overdue(self) -> None:
        while True:
            await asyncio.sleep(OVERDUE_INTERVAL)
            if (count := self.relay.take_overdue()) > 0:
                overdue = log_event("messages-overdue", lighthouse=self.lighthouse, count=count)
                log.warning("%s: other bridges did not send %d messages", self.lighthouse, count, extra=overdue)
                self._wake()

    async def _report(self) -> None:
        """Log changed counters rather than each message, so that a flood does not fill the log. Losses are warnings."""
        before: dict[str, int] = {}
        while True:
            await asyncio.sleep(self._report_interval)
            self._journal.prune()
            now = counters_of(status := self.status())
            if changes := changes_between(before, now):
                level = logging.WARNING if ".dropped." in changes else logging.INFO
                facts = {"lighthouse": self.lighthouse, "state": status.state, "carries": status.carries}
                report = log_event("bridge-reported", changes=changes, **facts)
                log.log(level, "%s: state=%s carries=%s %s", *facts.values(), changes, extra=report)
            before = now

    def _link_changed(self) -> None:
        if not self.link.up:
            self._presence.withdraw()
            return
        self._presence.announce(isolated=not self.link.listeners)
        if self.link.listeners and self.relay.queues[Side.IPFS].requeue_unheard():
            self._wake()

    def _answer(self, query: zenoh.Query) -> None:
        with query:
            if self.is_open:
                key = bridge_status_key(self.address, self.lighthouse)
                query.reply(key, self.status().encode(), encoding="application/json")


def _convert(sample: zenoh.Sample) -> MeshMessage | None:
    """Convert a sample on the pump's thread. The legacy channel has only orders, results and feedback."""
    key = str(sample.key_expr)
    if sample.kind != zenoh.SampleKind.PUT or market_kind(key) in ("reject", "decline", "report", "withdrawal"):
        return None
    attachment = sample.attachment
    return MeshMessage(key, sample.payload.to_bytes(), attachment is not None and attachment.to_bytes() == BRIDGE_MARK)
