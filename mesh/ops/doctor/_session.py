"""Sessions at a router: whether one opens, what this identity may write, and that everything else is denied.

A router does not report a denial: it drops the message. So a second session of the same identity subscribes to
keys that it may read and that no role may write, while the first session writes there. Whatever arrives was not denied.
These probe keys belong to no family of `schemas.keys`, so no program takes them for messages.
"""

from __future__ import annotations

import asyncio
import secrets
import time
from contextlib import ExitStack
from dataclasses import replace
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import zenoh

from mesh.base.background import call_in_loop
from mesh.errors import RemoteError
from mesh.network import Endpoints, Network
from mesh.network.locators import TLS_PREFIXES
from mesh.ops.doctor._machine import compare_clock
from mesh.ops.doctor.checks import CheckResult, failed, passed, warning
from mesh.ops.identity.routers import identity_denied, is_loopback
from schemas.keys import address_chunk, lighthouse_chunk, name_chunk

if TYPE_CHECKING:
    from collections.abc import Callable
    from contextlib import AsyncExitStack

    from mesh.ops.doctor.checks import DoctorContext

ANYBODY: Final = "0x" + "0" * 40
"""The address under which an identity without a certificate writes."""
STRANGER: Final = "0x" + "0" * 36 + "dead"
"""An address under which no other identity may write."""
ROSTER: Final = (
    "start the router with its roster: `aira router --roster FILE`, or zenohd with the output of `aira router config`"
)
MEASURED: Final = b"now"
"""The payload whose round trip is timed; earlier test writes may arrive late."""


class ProbePace(NamedTuple):
    """How long the checks of a session wait, in seconds."""

    opening: float = 3.0
    """Until the session is open."""
    forwarding: float = 2.0
    """Until the router would have forwarded a message that it allows."""
    writing: float = 0.05
    """Between two test writes."""
    grace: float = 0.2
    """Until everything written before a received message must have arrived, too."""


PROBE_PACE: Final = ProbePace()


class ProbeKeys(NamedTuple):
    """The keys of test writes: those at `own` must pass, those at `foreign` must be denied."""

    own: str
    foreign: dict[str, str]
    """By their descriptions."""

    @classmethod
    def of(cls, context: DoctorContext, address: str) -> ProbeKeys:
        """New keys for an identity."""
        chance = secrets.token_hex(8)
        if context.agent:
            agent = address_chunk(context.agent)
            own = f"aira/agent/{agent}/device/{name_chunk(context.device)}/doctor/{chance}"
            return cls(own, {"its agent's jobs": f"aira/agent/{agent}/liability/doctor/{chance}"})
        market = lighthouse_chunk(context.settings.lighthouse_contract)
        return cls(
            f"aira/agent/{address_chunk(address)}/doctor/{chance}",
            {
                f"the market {market}": f"aira/{market}/doctor/{chance}",
                "another agent's keys": f"aira/agent/{STRANGER}/doctor/{chance}",
            },
        )


class Received(NamedTuple):
    """A received sample, with the monotonic time (`at`) and the wall-clock time (`now`) of its arrival."""

    sample: zenoh.Sample
    at: float
    now: float


class SessionPair:
    """An open session that writes and one that reads.

    `stamped` is the router's timestamp of a sample and the wall-clock time of its arrival here (seconds since the
    epoch); None before the first sample.
    """

    def __init__(self, writer: zenoh.Session, reader: zenoh.Session) -> None:
        self._writer = writer
        self._reader = reader
        self.stamped: tuple[float, float] | None = None

    async def round_trip(self, key: str) -> float | None:
        """Seconds until the reader receives what is written at `key`; None if it never does."""
        heard: asyncio.Queue[Received] = asyncio.Queue()
        with ExitStack() as declared:
            self._subscribe(declared, key, heard.put_nowait)
            if not await self._comes_through(key, heard):
                return None
            began = time.monotonic()
            self._put(key, MEASURED)
            try:
                async with asyncio.timeout(PROBE_PACE.forwarding):
                    sample, at, now = await heard.get()
                    while sample.payload.to_bytes() != MEASURED:
                        sample, at, now = await heard.get()
            except TimeoutError:
                return None
            if sample.timestamp is not None:
                self.stamped = sample.timestamp.get_time().timestamp(), now
            return at - began

    async def is_subscribed(self, *keys: str) -> bool:
        """Whether the router forwards the reader's subscription to one of these keys to the writer."""
        with ExitStack() as declared:
            publishers = [self._watched(declared, key) for key in keys]
            return await _within(PROBE_PACE.forwarding, lambda: any(map(_is_matching, publishers)))

    async def delivered(
        self, foreign: tuple[str, ...], *, own: str, barrier: str | None
    ) -> tuple[tuple[str, ...], tuple[str, ...]]:
        """Those of the `foreign` keys that the reader may read, and those of them on which it received the writer.

        `own` is a key that the reader may read, `barrier` one that the writer may write: once that arrived, all that
        was written before has arrived or never will. Raises `RemoteError` if it does not arrive.
        """
        heard: set[str] = set()
        with ExitStack() as declared:
            publishers = {key: self._watched(declared, key, heard) for key in foreign}
            last = self._watched(declared, own, heard)
            await _within(PROBE_PACE.forwarding, lambda: _is_matching(last))
            await asyncio.sleep(PROBE_PACE.grace)
            tried = tuple(key for key, publisher in publishers.items() if _is_matching(publisher))
            for key in tried:
                self._put(key)
            if barrier is not None:
                self._put(barrier)
                if not await _within(PROBE_PACE.forwarding, lambda: barrier in heard):
                    raise RemoteError(
                        f"no allowed write arrived within {PROBE_PACE.forwarding:g} s,"
                        " so denied writes can't be detected",
                        hint="try again; the router or the network may be overloaded",
                        code="writes-undelivered",
                    )
                await asyncio.sleep(PROBE_PACE.grace)
            else:
                await asyncio.sleep(PROBE_PACE.forwarding)
        return tried, tuple(key for key in tried if key in heard)

    async def _comes_through(self, key: str, heard: asyncio.Queue[Received]) -> bool:
        """Write repeatedly until something arrives: the router learns of a subscriber with some delay."""
        ends = time.monotonic() + PROBE_PACE.forwarding
        while time.monotonic() < ends:
            self._put(key)
            try:
                async with asyncio.timeout(PROBE_PACE.writing):
                    await heard.get()
                    return True
            except TimeoutError:
                continue
        return False

    def _watched(self, declared: ExitStack, key: str, heard: set[str] | None = None) -> Any:
        """A publisher of the writer at `key`, to which the reader subscribes."""
        keys = set() if heard is None else heard
        self._subscribe(declared, key, lambda heard: keys.add(str(heard.sample.key_expr)))
        return declared.enter_context(self._writer.declare_publisher(key))

    def _subscribe(self, declared: ExitStack, key: str, take: Callable[[Received], object]) -> None:
        loop = asyncio.get_running_loop()

        def heard(sample: zenoh.Sample) -> None:
            call_in_loop(loop, take, Received(sample, time.monotonic(), time.time()))

        declared.enter_context(self._reader.declare_subscriber(key, heard))

    def _put(self, key: str, payload: bytes = b"") -> None:
        self._writer.put(key, payload, congestion_control=zenoh.CongestionControl.BLOCK)


class SessionChecks:
    """The checks with two sessions of this identity at the router `locator`. `check_session` opens them onto `stack`;
    the other checks need it to have passed."""

    def __init__(self, context: DoctorContext, locator: str, stack: AsyncExitStack) -> None:
        self._context = context
        self._locator = locator
        self._address = ANYBODY if context.identity is None else context.identity.address
        self._roles = context.certificate_roles
        self._keys = ProbeKeys("", {})
        self._stack = stack
        self._pair: SessionPair | None = None

    async def check_session(self) -> CheckResult:
        """Whether a session opens, and to which router. Raises `NetworkUnavailable`, `RemoteError`, `InvalidKey`."""
        self._keys = ProbeKeys.of(self._context, self._address)
        endpoints = replace(
            Endpoints.from_settings(self._context.settings), connect=(self._locator,), timeout=PROBE_PACE.opening
        )
        began = time.monotonic()
        writer = await self._stack.enter_async_context(Network(endpoints))
        took = time.monotonic() - began
        reader = await self._stack.enter_async_context(Network(endpoints))
        self._pair = SessionPair(writer.session, reader.session)
        routers = ", ".join(str(zid) for zid in writer.session.info.routers_zid())
        return passed(f"opened in {took * 1000:.0f} ms at the router {routers}")

    async def check_own_write(self) -> CheckResult:
        """Whether the router forwards what this identity may write. Raises `RemoteError`."""
        pair = self._opened()
        if self._roles == ("watcher",):
            if not await pair.is_subscribed(self._keys.own):
                raise identity_denied(self._address)
            return passed("a watcher may not write; the router forwards its subscriptions", code="watcher")
        took = await pair.round_trip(self._keys.own)
        if took is None:
            raise identity_denied(self._address)
        return passed(f"received through the router after {took * 1000:.1f} ms")

    async def check_denied_write(self) -> CheckResult:
        """Whether the router denies what no role may write."""
        pair = self._opened()
        barrier = self._keys.own if self._roles != ("watcher",) else None
        tried, delivered = await pair.delivered(tuple(self._keys.foreign.values()), own=self._keys.own, barrier=barrier)
        names = {key: name for name, key in self._keys.foreign.items()}
        if delivered:
            return self._open(" and ".join(names[key] for key in delivered))
        if not tried:
            return self._untried()
        return passed("denied as expected: " + " and ".join(f"a write to {names[key]}" for key in tried), code="denied")

    async def check_clock(self) -> CheckResult:
        """Compare this clock with the router's, which timestamps what it forwards."""
        stamped = self._opened().stamped
        if stamped is None:
            return passed("the router does not report its time", code="no-time")
        return compare_clock(*stamped, whose="the router's")

    def _opened(self) -> SessionPair:
        assert self._pair is not None, "check_session comes first"
        return self._pair

    def _open(self, where: str) -> CheckResult:
        """The result when the router forwarded a write that no role may make."""
        if "router" in self._roles:
            return passed(
                "not checked: a router's identity may write everything; use a member's identity", code="not-checked"
            )
        if self._locator.startswith(TLS_PREFIXES):
            return failed(
                f"the router allows any write: a write to {where} was forwarded", code="router-open", hint=ROSTER
            )
        if is_loopback(self._locator):
            return passed(
                "the router is open: every client may write everything, which is acceptable on loopback",
                code="router-open",
            )
        return failed(
            f"the router is open to every client that can reach it: a write to {where} was forwarded",
            code="router-open",
            hint="create a site with a roster and certificates (docs/guides/sites.md): `aira identity site FOLDER`",
        )

    def _untried(self) -> CheckResult:
        """The result when this identity may read none of the foreign keys, so that nothing could be checked."""
        if self._context.agent:
            return warning(
                "not checked: this identity can't read its agent's jobs",
                code="not-checked",
                hint="check --agent and --device of its entry: `aira router acl --check --roster FILE`",
            )
        return failed(
            f"the router does not let this identity read the market {self._context.settings.lighthouse_contract}",
            code="market-denied",
            hint="give --lighthouse-contract of the site, or add the market to `lighthouses` in the roster",
        )


def _is_matching(publisher: Any) -> bool:
    return bool(publisher.matching_status.matching)


async def _within(seconds: float, condition: Callable[[], bool]) -> bool:
    """Whether the condition becomes true within this many seconds."""
    ends = time.monotonic() + seconds
    while not condition():
        if time.monotonic() > ends:
            return False
        await asyncio.sleep(0.01)
    return True
