"""The bridge of one lighthouse between its keys on the mesh and its topic on IPFS.

- mesh → `Pump` → validator → relay → queue → IPFS
- IPFS → `DaemonLink` → validator → relay → queue → mesh
"""

from __future__ import annotations

import asyncio
import logging
import math
import re
import secrets
import time
from collections import deque
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import msgspec
import zenoh

from bridges.ipfs._relay import BRIDGE_ROLE, RELAY_LIMITS, MessageRelay, Side, rank_for, rank_of
from bridges.ipfs.daemon import IpfsError
from mesh.agent.demands import DeclinePublisher, Grounds
from mesh.base.background import call_in_loop
from mesh.base.flood import Drops
from mesh.base.lifecycle import Role
from mesh.base.log_context import log_event
from mesh.base.outage_log import OutageLog
from mesh.base.retry import Backoff, RetryPolicy
from mesh.errors import InvalidMessage
from mesh.network import Channel, MarketRules, NetworkChange, Pump, sending
from mesh.network.services import declared
from mesh.role.running import cause_of
from mesh.telemetry.metrics import MetricFamily, by_label, counter, gauge, labelled
from schemas import Demand, PresenceKey, Withdrawal, lighthouse_selector
from schemas.keys import KINDS, market_kind
from schemas.status import ALIVE, BridgeStatus, bridge_status_key

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Iterable, Iterator, Mapping
    from contextlib import AsyncExitStack

    from bridges.ipfs._relay import QueuedMessage, Rank, RelayJournal, RelayMessage, RelayValidator
    from bridges.ipfs.daemon import Daemon, PubsubMessage
    from mesh.network import Network
    from schemas import Offer, Signer, Verified
    from schemas.status import ContentMetrics, DirectionStatus

    Received = Callable[[PubsubMessage | None], Awaitable[None]]


RECONNECT: Final = RetryPolicy(initial=0.25, ceiling=10.0)
"""The first delay is short, since a restarted daemon is often back at once."""
PUBLISH_RETRY: Final = RetryPolicy(initial=0.5, factor=1.0, ceiling=0.5)
"""A steady, short delay: a failed message blocks those behind it, and an unreachable daemon is awaited elsewhere."""


class ListenerPace(NamedTuple):
    """How a topic's listeners are looked for."""

    poll: float = 1.0
    """Seconds between two questions about them."""
    settle: float = 1.5
    """Seconds that a swarm needs after the first one appears: nodes forward a topic's messages from their next
    heartbeat on, which takes up to a second."""


LISTENER_PACE: Final = ListenerPace()
BRIDGE_MARK: Final = b"ipfs"
"""The attachment of messages that a bridge puts on the mesh; other bridges do not send those back."""
_ENS_NAME: Final = re.compile(rb"\.(?:eth|sid|test)\"", re.IGNORECASE)
"""Occurs in every message that contains an ENS name."""
_NOT_LEGACY: Final = frozenset({"validator", *(name for name, kind in KINDS.items() if not kind.is_legacy)})
"""What is on a lighthouse's keys and not on the legacy network."""


GAUGES: Final = ("waiting", "left_waiting", "unheard", "adds_queued", "fetches_queued")
"""Fields of a direction that are current values rather than counts."""


class BridgeHealth(NamedTuple):
    """The status of one lighthouse's bridge, and whether its router and its daemon's subscription work."""

    status: BridgeStatus
    routed: bool
    subscribed: bool


def health_parts(bridges: Iterable[BridgeHealth]) -> Mapping[str, str]:
    """The health of these bridges of one process: part → `ALIVE` or the problem.

    Having no listeners on IPFS is healthy, and so is a bridge without a chain.
    """
    parts: dict[str, str] = {}
    for bridge in bridges:
        parts["router"] = ALIVE if bridge.routed else "waits for a router"
        problem = bridge.status.last_error or "waits for the daemon"
        parts[f"daemon for {bridge.status.lighthouse}"] = ALIVE if bridge.subscribed else problem
    return parts


def bridge_families(bridges: Iterable[BridgeHealth]) -> tuple[MetricFamily, ...]:
    """The metrics of each bridge, labelled with its lighthouse."""
    return tuple(
        family for bridge in bridges for family in labelled(_bridge(bridge), lighthouse=bridge.status.lighthouse)
    )


def counters_of(status: BridgeStatus) -> dict[str, int]:
    """All counters of a status, by names such as `to_ipfs.invalid.signature`."""
    counters = {"losses": status.losses}
    for part in ("to_ipfs", "to_mesh", "content"):
        counts = getattr(status, part)
        for name, value in () if counts is None else msgspec.structs.asdict(counts).items():
            if isinstance(value, int):
                counters[f"{part}.{name}"] = value
            elif isinstance(value, dict):
                counters |= {f"{part}.{name}.{reason}": count for reason, count in value.items()}
    return counters


def changes_between(before: Mapping[str, int], now: Mapping[str, int]) -> str:
    """The changed counters, as `name=+12` for counts and `name=12` for current values; empty without a change."""
    return " ".join(
        f"{name}={value}" if name.rpartition(".")[2] in GAUGES else f"{name}={value - before.get(name, 0):+d}"
        for name, value in now.items()
        if value != before.get(name, 0)
    )


def _bridge(bridge: BridgeHealth) -> Iterator[MetricFamily]:
    status = bridge.status
    for direction, counts in (("to-ipfs", status.to_ipfs), ("to-mesh", status.to_mesh)):
        yield from labelled(_direction(counts), direction=direction)
    subscribed, carries = float(bridge.subscribed), float(status.carries)
    yield gauge("aira_bridge_daemon_up", "1 while the daemon is subscribed, 0 otherwise", subscribed)
    yield counter("aira_bridge_daemon_losses_total", "How often the daemon was lost", status.losses)
    yield gauge("aira_bridge_carries", "1 while this bridge is active, 0 while it stands by", carries)
    yield gauge("aira_bridge_ipfs_peers", "Other nodes on the IPFS topic", len(status.ipfs_peers))
    yield gauge("aira_bridge_mesh_peers", "Agents on the lighthouse's channel in the mesh", len(status.mesh_peers))


def _direction(counts: DirectionStatus) -> tuple[MetricFamily, ...]:
    return (
        counter("aira_bridge_received_total", "Messages received from the other side", counts.received),
        by_label("aira_bridge_accepted_total", "counter", "Messages accepted, by kind", "kind", counts.kinds),
        by_label("aira_bridge_invalid_total", "counter", "Messages rejected, by reason", "reason", counts.invalid),
        counter("aira_bridge_known_total", "Messages that were on the destination side already", counts.known),
        counter("aira_bridge_carried_total", "Messages sent by this bridge", counts.carried),
        counter("aira_bridge_carried_bytes_total", "Messages sent by this bridge, bytes", counts.bytes),
        counter("aira_bridge_left_total", "Messages sent by another bridge", counts.left),
        by_label("aira_bridge_dropped_total", "counter", "Messages lost, by reason", "reason", counts.dropped),
        gauge("aira_bridge_waiting", "Messages waiting to be sent", counts.waiting),
        gauge("aira_bridge_left_waiting", "Messages left to another bridge that have not arrived", counts.left_waiting),
        gauge("aira_bridge_unheard", "Messages sent without listeners, to be sent again", counts.unheard),
    )


log = logging.getLogger(__name__)


class DaemonLink:
    """Receives a topic through `daemon` (open) whenever that is reachable: `await link.run(received, changed)`.

    `swarm_peers` are multiaddrs (`…/p2p/ID`) to which the daemon is kept connected.
    """

    def __init__(self, daemon: Daemon, topic: str, *, swarm_peers: tuple[str, ...] = ()) -> None:
        self.daemon: Final = daemon
        self.topic: Final = topic
        self._swarm_peers = swarm_peers
        self._unconnected: set[str] = set()
        self._outage = OutageLog(log, "ipfs-daemon")
        self._up = asyncio.Event()
        self.identity = ""
        """The daemon's peer id."""
        self.listeners: tuple[str, ...] = ()
        """The other nodes on the topic, as the daemon last reported them."""
        self.losses = 0
        """How often the daemon was lost."""
        self.error = ""
        """The last error; empty while all is well."""
        self._listeners_at = 0.0
        self._swarm_checked_at = 0.0
        self._heard_since = 0.0
        self._changed: Callable[[], None] = lambda: None

    @property
    def up(self) -> bool:
        return self._up.is_set()

    async def wait_up(self) -> None:
        await self._up.wait()

    async def run(self, received: Received, changed: Callable[[], None]) -> None:
        """Pass each message to `received` until cancelled; call `changed` when the link or the listeners change.

        `received` gets None for a line that can't be read.
        """
        self._changed = changed
        backoff = Backoff(RECONNECT)
        while True:
            try:
                await self._connected(received)
            except* IpfsError as group:
                error = cause_of(group)
                assert error is not None
                self._outage.failed(error, f"{self.topic}: not subscribed on IPFS")
                self.error = str(error)
            finally:
                was_up = self.up
                self._up.clear()
                self.listeners = ()
                if was_up:
                    self.losses += 1
                    self._changed()
            if was_up:
                backoff.reset()
            await backoff.wait()

    async def refresh_listeners(self, *, max_age: float = 0.0) -> bool:
        """Whether there are listeners. Asks the daemon, unless it named some less than `max_age` seconds ago.

        That nobody listens is never believed later: a message published in the meantime would be heard and sent again.
        Raises `IpfsError`.
        """
        now = asyncio.get_running_loop().time()
        if not self.listeners or now - self._listeners_at >= max_age:
            before, self.listeners = self.listeners, tuple(await self.daemon.listeners(self.topic))
            self._listeners_at = now
            if bool(before) != bool(self.listeners):
                self._heard_since = now
                if self.up:
                    count = len(self.listeners)
                    changed = log_event("ipfs-listeners-changed", lighthouse=self.topic, listeners=count)
                    log.info("%s: %d listeners", self.topic, count, extra=changed)
                    self._changed()
        return bool(self.listeners)

    async def settled(self) -> None:
        """Return when messages reach all listeners, not only the daemon's neighbours; at once if there are none."""
        since = asyncio.get_running_loop().time() - self._heard_since
        if self.listeners and since < LISTENER_PACE.settle:
            await asyncio.sleep(LISTENER_PACE.settle - since)

    async def _connected(self, received: Received) -> None:
        version = await self.daemon.detect_version()
        self.identity = await self.daemon.identity()
        async with asyncio.TaskGroup() as tasks, self.daemon.subscribe(self.topic) as messages:
            self._swarm_checked_at = 0.0
            await self.refresh_listeners()
            self.error = ""
            self._up.set()
            self._outage.recovered(f"{self.topic}: the IPFS daemon is back")
            subscribed = log_event("ipfs-subscribed", lighthouse=self.topic, api=self.daemon.api, version=version)
            words = f"{self.daemon.api} ({version}, {self.daemon.dialect})"
            log.info("%s: subscribed at %s", self.topic, words, extra=subscribed)
            self._changed()
            tasks.create_task(self._poll(), name=f"listeners of {self.topic}")
            async for message in messages:
                await received(message)

    async def _poll(self) -> None:
        """Ask for listeners periodically. This detects a daemon that stopped answering but kept its connections."""
        while True:
            await self._check_swarm()
            await self.refresh_listeners()
            await asyncio.sleep(LISTENER_PACE.poll)

    async def _check_swarm(self) -> None:
        now = asyncio.get_running_loop().time()
        if not self._swarm_peers or (self._swarm_checked_at and now - self._swarm_checked_at < 30.0):
            return
        self._swarm_checked_at = now
        connected = set(await self.daemon.swarm_peers())
        for address in self._swarm_peers:
            if address.rpartition("/")[2] not in connected:
                await self._connect_peer(address)

    async def _connect_peer(self, address: str) -> None:
        try:
            await self.daemon.connect(address)
        except IpfsError as error:
            if address not in self._unconnected:
                failed = log_event("swarm-peer-unreachable", lighthouse=self.topic, peer=address, error=error)
                log.warning("%s: not connected to %s: %s", self.topic, address, error, extra=failed)
            self._unconnected.add(address)
        else:
            connected = log_event("swarm-peer-connected", lighthouse=self.topic, peer=address)
            log.info("%s: connected to %s", self.topic, address, extra=connected)
            self._unconnected.discard(address)


@dataclass(frozen=True, kw_only=True)
class BridgeParts:
    """What a bridge works with; the caller closes it. `validator` knows its lighthouse; `journal` is its own."""

    network: Network
    daemon: Daemon
    validator: RelayValidator
    journal: RelayJournal
    drops: Drops = field(default_factory=Drops)
    signer: Signer | None = None
    """Whose address the bridge has, if it declines demands that are too large for the legacy network."""
    published: Callable[[Side, RelayMessage], None] = lambda side, message: None
    """Called with each message that this bridge has sent."""
    content: Callable[[], ContentMetrics | None] = lambda: None
    """Metrics for the status."""


class ChannelBridge(Role):
    """Relays messages both ways: `async with ChannelBridge(parts) as bridge`, then `run`.

    `address` identifies the bridge on the mesh, by default a random one; `swarm_peers` are multiaddrs to which the
    daemon is kept connected; `limit` bounds the queue of each direction. Changed counters are logged every
    `report_interval` seconds.

    An accepted message waits in the journal, even if `run` is cancelled, until the daemon has accepted it and names a
    listener. If the daemon dies during a call, the message may have gone out and is published again. What
    the daemon or other nodes lose after that is lost until its sender repeats it: then it is relayed again
    (`relay.REPETITION`).
    """

    title = "bridge"

    def __init__(
        self,
        parts: BridgeParts,
        *,
        address: str | None = None,
        swarm_peers: tuple[str, ...] = (),
        limit: int = RELAY_LIMITS.waiting,
        report_interval: float = 60.0,
    ) -> None:
        self.lighthouse: Final = parts.validator.rules.lighthouse
        self.address: Final = (address or f"0x{secrets.token_hex(20)}").lower()
        self._parts = parts
        self._network = parts.network
        self._validator = parts.validator
        self.withdrawals: Final = parts.validator.withdrawals
        """Those that are known; the orders that they concern are not relayed."""
        self.link: Final = DaemonLink(parts.daemon, self.lighthouse, swarm_peers=swarm_peers)
        self.relay: Final = MessageRelay(time.monotonic, parts.journal, limit=limit)
        self._report_interval = report_interval
        self._started = time.monotonic()
        self._lookups = asyncio.Semaphore(256)
        self._online = asyncio.Event()
        self._waiting = {side: asyncio.Event() for side in Side}
        self._sent_at: dict[Side, deque[float]] = {side: deque(maxlen=100_000) for side in Side}
        self._puts: deque[tuple[float, RelayMessage]] = deque(maxlen=4096)
        self._rank_token: Any = None
        self._isolated = False
        self._present: set[PresenceKey] = set()

    async def _open(self, stack: AsyncExitStack) -> None:
        session = self._network.session
        channel = await stack.enter_async_context(
            Channel(session, MarketRules(self.lighthouse, head=self._validator.rules.head), drops=self._parts.drops)
        )
        if self._parts.signer is not None:
            self._declines = DeclinePublisher(channel, self._parts.signer, self._parts.drops)
            self._validator.on_too_large = self._decline
        self._withdrawn = await stack.enter_async_context(channel.subscribe(Withdrawal))
        self._pump = await stack.enter_async_context(Pump(session, lighthouse_selector(self.lighthouse), _convert))
        stack.callback(self._announce, None)
        # Other bridges must be known before the first message is accepted; the watch reports them only later.
        for key in await channel.present():
            self._appeared(key)
        # After the subscription: once its token is seen, the bridge receives what is published.
        channel.announce(BRIDGE_ROLE, self.address)
        channel.watch_presence(self._appeared, gone=self._gone)
        loop = asyncio.get_running_loop()
        queryable = session.declare_queryable(
            bridge_status_key(self.address, self.lighthouse), lambda query: call_in_loop(loop, self._answer, query)
        )
        stack.enter_context(declared(session, queryable))
        self.relay.restore()
        self._wake()

    async def _work(self) -> None:
        work = {
            "withdrawals": self._take_withdrawals(),
            "the router": self._follow_network(),
            "from the mesh": self._receive_from_mesh(),
            "from IPFS": self.link.run(self._receive_from_ipfs, self._link_changed),
            "to IPFS": self._publish_to_ipfs(),
            "to the mesh": self._publish_to_mesh(),
            "report": self._report(),
        }
        async with asyncio.TaskGroup() as tasks:
            self._tasks = tasks
            for name, one in work.items():
                tasks.create_task(one, name=f"bridge of {self.lighthouse}: {name}")

    def status(self) -> BridgeStatus:
        daemon, drops = self._parts.daemon, self._parts.drops
        return BridgeStatus(
            bridge=self.address,
            lighthouse=self.lighthouse,
            state=self._state(),
            carries=self.relay.is_active,
            api=daemon.api,
            daemon=str(daemon.version or ""),
            dialect=daemon.dialect,
            ipfs_peers=self.link.listeners,
            mesh_peers=tuple(sorted(f"{key.role} {key.agent}" for key in self._present)),
            losses=self.link.losses,
            last_error=self.link.error,
            to_ipfs=self.relay.status(Side.IPFS, per_second=self._rate(Side.IPFS)),
            to_mesh=self.relay.status(Side.MESH, per_second=self._rate(Side.MESH)),
            content=self._parts.content(),
            uptime=round(time.monotonic() - self._started, 1),
            dropped=drops.totals(),
            heaviest=drops.senders(),
        )

    def health(self) -> BridgeHealth:
        """The status, and whether the router and the daemon are connected."""
        return BridgeHealth(self.status(), routed=self._network.connected, subscribed=self.link.up)

    def _rate(self, side: Side) -> float:
        window = 10.0  # seconds
        since = time.monotonic() - window
        return sum(at > since for at in self._sent_at[side]) / window

    def _state(self) -> str:
        if not self._network.connected:
            return "no router"
        if not self.link.up:
            return "no daemon"
        return "connected" if self.link.listeners else "alone"

    def _answer(self, query: zenoh.Query) -> None:
        with query:
            if self.is_open:
                key = bridge_status_key(self.address, self.lighthouse)
                query.reply(key, self.status().encode(), encoding="application/json")

    async def _take_withdrawals(self) -> None:
        async for withdrawal in self._withdrawn:
            self.withdrawals.expire(self._validator.rules.head())
            if self.withdrawals.add(withdrawal):
                self.relay.drop_withdrawn(withdrawal.message.order, self.withdrawals)
            else:
                self._withdrawn.forget(withdrawal)

    async def _follow_network(self) -> None:
        """Pause while there is no router. When one is there, ask the providers for the withdrawals that they know, and
        repeat the puts that may have vanished; receivers drop duplicates."""
        if self._network.connected:
            self._online.set()
        await self._withdrawn.recall()
        lost = math.inf
        async for change in self._network.changes():
            if change is NetworkChange.LOST:
                self._online.clear()
                lost = time.monotonic()
            else:
                for at, message in list(self._puts):
                    if at > lost - 3.0:  # those may already have vanished
                        self._put(message)
                self._online.set()
                await self._withdrawn.recall()

    async def _receive_from_mesh(self) -> None:
        dropped = number = 0
        async for key, payload, by_bridge in self._pump:
            number += 1
            if number % 16 == 0:
                await asyncio.sleep(0)  # others publish meanwhile
            if (lost := self._pump.dropped - dropped) > 0:
                dropped += lost
                self.relay.dropped[Side.IPFS]["unseen"] += lost
            await self._receive(payload, Side.MESH, key=key, by_bridge=by_bridge)

    async def _receive_from_ipfs(self, message: PubsubMessage | None) -> None:
        if message is None:
            self._reject(Side.IPFS, InvalidMessage("line", "unreadable line from the daemon"))
        else:
            await self._receive(message.data, Side.IPFS, echo=message.sender == self.link.identity)

    async def _receive(
        self, payload: bytes, side: Side, *, key: str | None = None, echo: bool = False, by_bridge: bool = False
    ) -> None:
        self.relay.counts[side.other]["received"] += 1
        accepting = self._accept(payload, side, key=key, echo=echo, by_bridge=by_bridge)
        if not _ENS_NAME.search(payload):
            await accepting
        elif self._lookups.locked():
            accepting.close()
            self._reject(side, InvalidMessage("name", "too many messages wait for the resolution of names"))
        else:  # later messages may overtake this one
            await self._lookups.acquire()
            task = self._tasks.create_task(accepting, name="resolve names of a message")
            task.add_done_callback(lambda _: self._lookups.release())

    async def _accept(self, payload: bytes, side: Side, *, key: str | None, echo: bool, by_bridge: bool) -> None:
        try:
            message = await self._validator.validate(payload, key=key)
        except InvalidMessage as error:
            self._reject(side, error)
            return
        if self.relay.receive(message, side, echo=echo, by_bridge=by_bridge):
            self._waiting[side.other].set()

    def _decline(self, order: Verified[Demand | Offer], why: str) -> None:
        """Tell the maker of a demand that legacy robots don't get it, if this bridge is the one that carries."""
        if isinstance(order.message, Demand) and self.relay.is_active:
            grounds = Grounds("too-large", f"this bridge does not pass it on to IPFS: {why}")
            self._declines.decline(order, grounds)  # type: ignore[arg-type]

    def _reject(self, side: Side, error: InvalidMessage) -> None:
        self.relay.invalid[side.other][error.reason] += 1
        log.debug("%s: rejected a message from %s: %s", self.lighthouse, side.value, error)

    def _wake(self) -> None:
        for event in self._waiting.values():
            event.set()

    async def _next(self, side: Side) -> QueuedMessage:
        """The next message to a side, as soon as there is one; it stays in the queue."""
        while (queued := self.relay.next(side)) is None:
            self._waiting[side].clear()
            await self._waiting[side].wait()
        return queued

    def _sent(self, queued: QueuedMessage, side: Side, *, heard: bool = True) -> None:
        self._sent_at[side].append(time.monotonic())
        self.relay.sent(queued, side, heard=heard)
        self._parts.published(side, queued.message)

    async def _publish_to_ipfs(self) -> None:
        """Publish one message after another while the daemon is subscribed. Failed ones are retried, or dropped and
        counted."""
        refusals, backoff = 0, Backoff(PUBLISH_RETRY)
        while True:
            queued = await self._next(Side.IPFS)
            await self.link.wait_up()
            try:
                await self._publish(queued)
                refusals = 0
                backoff.reset()
            except (IpfsError, ValueError) as error:
                code = error.code if isinstance(error, IpfsError) else ""
                refusals += code not in ("no-peers", "published-out-of-order", "daemon-unreachable")
                if refusals == 5:
                    refusals, key = 0, queued.message.key
                    self.relay.refused(queued, Side.IPFS)
                    dropped = log_event("message-dropped", lighthouse=self.lighthouse, key=key, error=error)
                    log.warning("%s: IPFS refuses %s: %s", self.lighthouse, key, error, extra=dropped)
                    continue
                if code not in ("no-peers", "published-out-of-order"):  # these happen now and then
                    self.link.error = str(error)
                await backoff.wait()

    async def _publish(self, queued: QueuedMessage) -> None:
        heard = await self.link.refresh_listeners(max_age=0.1)
        await self.link.settled()
        if self.relay.next(Side.IPFS) is not queued:
            return  # another node has published it meanwhile, or it is another bridge's turn
        await self._parts.daemon.publish(self.lighthouse, queued.message.legacy)
        self.link.error = ""
        self._sent(queued, Side.IPFS, heard=heard)

    async def _publish_to_mesh(self) -> None:
        """Put one message after another while a router is connected."""
        while True:
            await self._online.wait()
            queued = await self._next(Side.MESH)
            if self._online.is_set():
                self._put(queued.message)
                self._puts.append((time.monotonic(), queued.message))
                self._sent(queued, Side.MESH)
                await asyncio.sleep(0)

    def _put(self, message: RelayMessage) -> None:
        sending.put(self._network.session, message.key, message.payload, attachment=BRIDGE_MARK)

    def _link_changed(self) -> None:
        isolated = not self.link.listeners
        if not self.link.up:
            self._announce(None)
        elif self.relay.own is None or self._isolated != isolated:
            self._isolated = isolated
            self._announce(rank_for(isolated=isolated, since_ns=time.time_ns(), bridge=self.address))
        if not isolated:
            self.relay.requeue_unheard()
        self._wake()

    def _announce(self, rank: Rank | None) -> None:
        """This bridge can send, with a new rank; None: it can't."""
        session, before, self._rank_token = self._network.session, self._rank_token, None
        self.relay.own = rank
        if rank is not None:
            self._rank_token = session.liveliness().declare_token(str(PresenceKey(self.lighthouse, *rank)))
        if before is not None and not session.is_closed():
            before.undeclare()

    def _appeared(self, key: PresenceKey) -> None:
        rank = rank_of(key)
        if rank is None:
            if len(self._present) < 1024:
                self._present.add(key)
        elif key.agent != self.address and len(self.relay.others) < 64:
            self.relay.others.add(rank)

    def _gone(self, key: PresenceKey) -> None:
        rank = rank_of(key)
        if rank is None:
            self._present.discard(key)
        elif key.agent != self.address:
            self.relay.others.discard(rank)
            self._wake()

    async def _report(self) -> None:
        """Log changed counters rather than each message, so that a flood does not fill the log. Losses are warnings."""
        before: dict[str, int] = {}
        while True:
            await asyncio.sleep(self._report_interval)
            self._parts.journal.prune()
            self.relay.expire()
            now = counters_of(status := self.status())
            if changes := changes_between(before, now):
                level = logging.WARNING if ".dropped." in changes else logging.INFO
                facts = {"lighthouse": self.lighthouse, "state": status.state, "carries": status.carries}
                report = log_event("bridge-reported", changes=changes, **facts)
                log.log(level, "%s: state=%s carries=%s %s", *facts.values(), changes, extra=report)
            before = now


def _convert(sample: zenoh.Sample) -> tuple[str, bytes, bool] | None:
    """The key and the payload of a message on the mesh, and whether a bridge put it there. On the pump's thread."""
    key = str(sample.key_expr)
    if sample.kind != zenoh.SampleKind.PUT or market_kind(key) in _NOT_LEGACY:
        return None
    attachment = sample.attachment
    return key, sample.payload.to_bytes(), attachment is not None and attachment.to_bytes() == BRIDGE_MARK
