"""The network as this identity has it: a session, what it may write, and that what it must not write is denied.

A router tells nobody that it denies him something: what is denied just vanishes. So a second session of the same
identity listens on keys that it may hear and that no role may write, while the first one writes there. What comes
through has not been denied. Nobody takes these keys for messages: none belongs to a family of `schemas.keys`.
"""

from __future__ import annotations

import secrets
import time
from dataclasses import replace
from typing import TYPE_CHECKING, Final, NamedTuple

from mesh.doctor.clock import against_router
from mesh.doctor.findings import Finding, broken, doubtful, sound
from mesh.doctor.writing import Pair
from mesh.identity.admission import NotAdmittedYet
from mesh.identity.routers import is_loopback
from mesh.network import Endpoints, Network
from mesh.network.endpoints import TLS_PREFIXES
from schemas.key_chunks import address_chunk, lighthouse_chunk, name_chunk

if TYPE_CHECKING:
    from contextlib import AsyncExitStack

    from mesh.doctor.case import Case

PATIENCE: Final = 3.0
"""Seconds in which a session opens."""
ANYBODY: Final = "0x" + "0" * 40
"""In whose name writes who has no certificate."""
STRANGER: Final = "0x" + "0" * 36 + "dead"
"""In whose space nobody else may write."""
ROSTER: Final = (
    "start the router with its roster: `aira router --roster FILE`, or zenohd with what `aira router config` writes"
)


class Keys(NamedTuple):
    """Where it is tried to write: what is `own` may pass, and nothing of what is `foreign`."""

    own: str
    foreign: dict[str, str]
    """By what people call it."""

    @classmethod
    def of(cls, case: Case, address: str) -> Keys:
        """The keys for an identity, new ones each time."""
        chance = secrets.token_hex(8)
        if case.agent:
            agent = address_chunk(case.agent)
            own = f"aira/agent/{agent}/device/{name_chunk(case.device)}/doctor/{chance}"
            return cls(own, {"the jobs of its agent": f"aira/agent/{agent}/liability/doctor/{chance}"})
        market = lighthouse_chunk(case.settings.lighthouse_contract)
        return cls(
            f"aira/agent/{address_chunk(address)}/doctor/{chance}",
            {
                f"the market {market}": f"aira/{market}/doctor/{chance}",
                "the space of another": f"aira/agent/{STRANGER}/doctor/{chance}",
            },
        )


class Wire:
    """Two sessions of a case's identity at the router of `locator`, to be checked; `check_session` opens them onto
    `stack` for the checks behind it."""

    def __init__(self, case: Case, locator: str, stack: AsyncExitStack) -> None:
        self._case = case
        self._locator = locator
        self._address = ANYBODY if case.identity is None else case.identity.address
        self._roles = case.shown_roles
        self._keys = Keys("", {})
        self._stack = stack
        self._pair: Pair | None = None

    async def check_session(self) -> Finding:
        """That a session opens, and to which router. Raises `NetworkUnavailable`, `NotAdmitted`, `InvalidKey`."""
        self._keys = Keys.of(self._case, self._address)
        endpoints = replace(Endpoints.from_settings(self._case.settings), connect=(self._locator,), timeout=PATIENCE)
        began = time.monotonic()
        writer = await self._stack.enter_async_context(Network(endpoints))
        took = time.monotonic() - began
        reader = await self._stack.enter_async_context(Network(endpoints))
        self._pair = Pair(writer.session, reader.session)
        routers = ", ".join(str(zid) for zid in writer.session.info.routers_zid())
        return sound(f"open in {took * 1000:.0f} ms, at the router {routers}")

    async def check_own_write(self) -> Finding:
        """That the router passes on what this identity may write. Raises `NotAdmittedYet`."""
        pair = self._opened()
        if self._roles == ("watcher",):
            await self._check_heard(pair)
            return sound("a watcher writes nothing; what it wants to hear, the router sends")
        took = await pair.round_trip(self._keys.own)
        if took is None:
            raise NotAdmittedYet(self._address)
        return sound(f"heard back through the router in {took * 1000:.1f} ms")

    async def check_denied_write(self) -> Finding:
        """That nothing passes which no role may write."""
        pair = self._opened()
        barrier = self._keys.own if self._roles != ("watcher",) else None
        tried, passed = await pair.passing(tuple(self._keys.foreign.values()), own=self._keys.own, barrier=barrier)
        names = {key: name for name, key in self._keys.foreign.items()}
        if passed:
            return self._open(" and ".join(names[key] for key in passed))
        if not tried:
            return self._untried()
        return sound("refused, as it should be: " + " and ".join(f"a write in {names[key]}" for key in tried))

    async def check_clock(self) -> Finding:
        """The router's clock, which it puts on what it passes on, against this one."""
        stamped = self._opened().stamped
        if stamped is None:
            return sound("the router does not tell its time")
        return against_router(*stamped)

    def _opened(self) -> Pair:
        assert self._pair is not None, "the session's check comes first"
        return self._pair

    async def _check_heard(self, pair: Pair) -> None:
        if not await pair.is_heeded(self._keys.own):
            raise NotAdmittedYet(self._address)

    def _open(self, where: str) -> Finding:
        """The router let a write pass that no role may make."""
        if "router" in self._roles:
            return sound("not tried: a router's own identity may write everything; ask with a member's")
        if self._locator.startswith(TLS_PREFIXES):
            return broken(f"the router lets anybody write anything: a write in {where} came through", do=ROSTER)
        if is_loopback(self._locator):
            return sound("the router is open: everybody may write everything, which is fine on this machine alone")
        return broken(
            f"the router is open to everybody who reaches it: a write in {where} came through",
            do="begin a site with a roster and certificates, as docs/sites.md shows: `aira identity site FOLDER`",
        )

    def _untried(self) -> Finding:
        """Nothing could have been heard: this identity may hear nothing that others must not write."""
        if self._case.agent:
            return doubtful(
                "not tried: this identity hears nothing of its agent's jobs",
                do="does the roster name this --agent and --device for it? `aira router acl --check --roster FILE`",
            )
        return broken(
            f"the router does not let this identity hear the market {self._case.settings.lighthouse_contract}",
            do="give --lighthouse-contract of the site, or have the market named in the roster's `lighthouses`",
        )
