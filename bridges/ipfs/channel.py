"""The bridge of one lighthouse between the mesh's keys and the IPFS topic of its name."""

from __future__ import annotations

import asyncio
import logging
import re
import secrets
import time
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import zenoh

from bridges.ipfs.carrying import MARK, ToIpfs, ToMesh
from bridges.ipfs.link import Link
from bridges.ipfs.memory import Side
from bridges.ipfs.metrics import Standing
from bridges.ipfs.presence import Presence
from bridges.ipfs.report import figures_of, news
from bridges.ipfs.status import BridgeStatus, status_key
from bridges.ipfs.traffic import LIMIT, Fate, Traffic
from mesh.errors import InvalidMessage
from mesh.network import Pump, call_in_loop
from mesh.role import Role
from schemas import lighthouse_selector

if TYPE_CHECKING:
    from collections.abc import Callable
    from contextlib import AsyncExitStack

    from bridges.ipfs.daemon import Daemon
    from bridges.ipfs.dialects import Event
    from bridges.ipfs.gate import Gate, Passenger
    from bridges.ipfs.journal import Journal
    from mesh.network import Network
    from schemas.status import ContentMetrics

log = logging.getLogger(__name__)

LOOK: Final = 1.0
"""Seconds between two looks at what was left to other bridges."""
REPORT: Final = 60.0
"""Seconds between two lines of the log with what was done meanwhile."""
LOOKING_UP: Final = 256
"""Messages that wait for their ENS names at most."""
_NAMED: Final = re.compile(rb"\.(?:eth|sid|test)\"", re.IGNORECASE)
"""A message that holds an ENS name has this somewhere."""


class Sample(NamedTuple):
    """What came on the mesh; `marked` if a bridge has put it."""

    key: str
    payload: bytes
    marked: bool


class ChannelBridge(Role):
    """Carries messages both ways: `async with ChannelBridge(...) as bridge`, then `run`.

    `gate` checks what passes for `lighthouse` (ENS name); `journal` is this bridge's own memory; `neighbours` are swarm
    addresses to keep the daemon connected to; `address` is the bridge's name on the mesh, by default a new one;
    `carried` is told of each message that this bridge has put on a side; `content` gives the figures of what this one
    does with content. What was done is logged every `report` seconds in which something was.

    Network, daemon and journal stay the caller's to close.

    A message that was accepted is carried, and once: it waits in the journal until the daemon has taken it, also when
    `run` is cancelled meanwhile. When the daemon dies in the middle of a call nobody can know whether that one message
    went out, and it is published again; what a daemon took in its very last moment may be lost with it, until its
    sender sends it again.
    """

    title = "bridge"

    def __init__(
        self,
        network: Network,
        daemon: Daemon,
        gate: Gate,
        journal: Journal,
        *,
        lighthouse: str,
        neighbours: tuple[str, ...] = (),
        address: str | None = None,
        limit: int = LIMIT,
        carried: Callable[[Side, Passenger], None] = lambda side, passenger: None,
        content: Callable[[], ContentMetrics | None] = lambda: None,
        report: float = REPORT,
    ) -> None:
        self.lighthouse: Final = lighthouse.lower()
        self.address: Final = (address or f"0x{secrets.token_hex(20)}").lower()
        self._network = network
        self._daemon = daemon
        self._gate = gate
        self._journal = journal
        self.link: Final = Link(daemon, self.lighthouse, neighbours=neighbours)
        self.traffic: Final = Traffic(time.monotonic, journal, limit=limit)
        self._to_ipfs = ToIpfs(self.link, self.traffic, carried)
        self._to_mesh = ToMesh(network, self.traffic, carried)
        self._content = content
        self._report_interval = report
        self._began = time.monotonic()
        self._looking_up = asyncio.Semaphore(LOOKING_UP)

    async def _open(self, stack: AsyncExitStack) -> None:
        session = self._network.session
        self._pump: Pump[Sample] = await stack.enter_async_context(
            Pump(session, lighthouse_selector(self.lighthouse), _read)
        )
        # After the subscription: who sees the bridge's token can be sure to be heard.
        self._presence = await stack.enter_async_context(
            Presence(session, self.lighthouse, self.address, self.traffic, wake=self._wake)
        )
        loop = asyncio.get_running_loop()
        queryable: Any = session.declare_queryable(
            status_key(self.address, self.lighthouse), lambda query: call_in_loop(loop, self._answer, query)
        )
        stack.callback(lambda: None if session.is_closed() else queryable.undeclare())
        self._restore()

    async def _work(self) -> None:
        async with asyncio.TaskGroup() as tasks:
            self._tasks = tasks
            tasks.create_task(self._take_from_mesh(), name=f"mesh → bridge {self.lighthouse}")
            tasks.create_task(self.link.run(self._take_from_ipfs, self._link_changed), name=f"IPFS → {self.lighthouse}")
            tasks.create_task(self._to_ipfs.run(), name=f"bridge → IPFS {self.lighthouse}")
            tasks.create_task(self._to_mesh.run(), name=f"bridge → mesh {self.lighthouse}")
            tasks.create_task(self._look_after_left(), name=f"left over {self.lighthouse}")
            tasks.create_task(self._report(), name=f"report of {self.lighthouse}")

    def status(self) -> BridgeStatus:
        """How it is now."""
        own, others = self.traffic.own, self.traffic.others
        return BridgeStatus(
            bridge=self.address,
            lighthouse=self.lighthouse,
            state=self._state(),
            carries=own is not None and all(own < other for other in others),
            api=self._daemon.api,
            daemon=str(self._daemon.version or ""),
            dialect=self._daemon.dialect,
            ipfs_peers=self.link.listeners,
            mesh_peers=tuple(sorted(f"{key.role} {key.agent}" for key in self._presence.present)),
            losses=self.link.losses,
            last_error=self.link.error,
            to_ipfs=self.traffic.way(Side.IPFS, per_second=self._to_ipfs.rate.per_second()),
            to_mesh=self.traffic.way(Side.MESH, per_second=self._to_mesh.rate.per_second()),
            content=self._content(),
            uptime=round(time.monotonic() - self._began, 1),
        )

    def standing(self) -> Standing:
        """How it is now, and what it stands on."""
        return Standing(self.status(), routed=self._network.connected, subscribed=self.link.up)

    def _state(self) -> str:
        if not self._network.connected:
            return "no router"
        if not self.link.up:
            return "no daemon"
        return "connected" if self.link.listeners else "alone"

    async def _take_from_mesh(self) -> None:
        dropped = 0
        async for sample in self._pump:
            if (lost := self._pump.dropped - dropped) > 0:
                dropped += lost
                self.traffic.dropped[Side.IPFS]["unseen"] += lost
            await self._take(sample.payload, Side.MESH, key=sample.key, by_bridge=sample.marked)

    async def _take_from_ipfs(self, event: Event | None) -> None:
        if event is None:
            self._refuse(Side.IPFS, InvalidMessage("line", "the daemon's line can't be read"))
        else:
            await self._take(event.data, Side.IPFS, echo=event.sender == self.link.identity)

    async def _take(
        self, payload: bytes, side: Side, *, key: str | None = None, echo: bool = False, by_bridge: bool = False
    ) -> None:
        self.traffic.counts[side.other]["received"] += 1
        if not _NAMED.search(payload):
            await self._pass(payload, side, key=key, echo=echo, by_bridge=by_bridge)
        elif self._looking_up.locked():
            self._refuse(side, InvalidMessage("name", "too many messages wait for their names"))
        else:  # others overtake a message whose names are looked up
            await self._looking_up.acquire()
            looking_up = self._pass(payload, side, key=key, echo=echo, by_bridge=by_bridge)
            task = self._tasks.create_task(looking_up, name="names of a message")
            task.add_done_callback(lambda _: self._looking_up.release())

    async def _pass(self, payload: bytes, side: Side, *, key: str | None, echo: bool, by_bridge: bool) -> None:
        try:
            passenger = await self._gate.admit(payload, key=key)
        except InvalidMessage as error:
            self._refuse(side, error)
            return
        if self.traffic.seen(passenger, side, echo=echo, by_bridge=by_bridge) is Fate.ACCEPTED:
            self._wake()

    def _refuse(self, side: Side, error: InvalidMessage) -> None:
        self.traffic.invalid[side.other][error.reason] += 1
        log.debug("%s: from %s: %s", self.lighthouse, side.value, error)

    def _wake(self) -> None:
        self._to_ipfs.wake()
        self._to_mesh.wake()

    async def _look_after_left(self) -> None:
        while True:
            await asyncio.sleep(LOOK)
            if (count := self.traffic.look_after_left()) > 0:
                log.warning("%s: %d messages that other bridges did not carry", self.lighthouse, count)
                self._wake()

    async def _report(self) -> None:
        """Say what was done, not each message: a flood must not become one of the log. Losses are warnings."""
        before: dict[str, int] = {}
        while True:
            await asyncio.sleep(self._report_interval)
            self._journal.tidy()
            now = figures_of(status := self.status())
            if said := news(before, now):
                level = logging.WARNING if ".dropped." in said else logging.INFO
                log.log(level, "%s: state=%s carries=%s %s", self.lighthouse, status.state, status.carries, said)
            before = now

    def _link_changed(self) -> None:
        if not self.link.up:
            self._presence.hide()
            return
        self._presence.show(deaf=not self.link.listeners)
        if self.link.listeners and self.traffic.to[Side.IPFS].say_again():
            self._wake()

    def _restore(self) -> None:
        for fingerprint, age in self._journal.known():
            for side in Side:
                self.traffic.memory.note(fingerprint, side, age=age)
        for side, waiting in self._journal.left_over():
            waiting.since = time.monotonic()
            self.traffic.restore(waiting, side)
        self._wake()

    def _answer(self, query: zenoh.Query) -> None:
        with query:
            if self.is_open:
                query.reply(
                    status_key(self.address, self.lighthouse), self.status().encode(), encoding="application/json"
                )


def _read(sample: zenoh.Sample) -> Sample | None:
    """What the pump's thread makes of a sample. Why a provider rejects an order has no place on the legacy channel."""
    key = str(sample.key_expr)
    if sample.kind != zenoh.SampleKind.PUT or key.split("/")[2:3] == ["reject"]:
        return None
    attachment = sample.attachment
    return Sample(key, sample.payload.to_bytes(), attachment is not None and attachment.to_bytes() == MARK)
