"""Which bridges are there and whose turn it is, as Zenoh's liveliness tokens show it."""

from __future__ import annotations

import asyncio
import time
from typing import TYPE_CHECKING, Any, Final, Self

import zenoh

from bridges.ipfs.turns import ROLE, Turn, turn_of
from mesh.network import call_in_loop
from schemas import InvalidKey, PresenceKey, parse_key, presence_selector

if TYPE_CHECKING:
    from collections.abc import Callable
    from types import TracebackType

    from bridges.ipfs.traffic import Traffic

TIMEOUT: Final = 5.0
"""Seconds to ask who is there."""
LIMIT: Final = 65_536
"""Tokens that are read, and agents that are known, at most."""


class Presence:
    """Tells `traffic` of the other bridges' turns, and shows this one's: `async with Presence(...) as presence`.

    `bridge` is this bridge's address; `wake` is called when there may be something to carry that was another's. Leaving
    `async with` withdraws what it shows.
    """

    def __init__(
        self, session: zenoh.Session, lighthouse: str, bridge: str, traffic: Traffic, *, wake: Callable[[], None]
    ) -> None:
        self._session = session
        self._lighthouse = lighthouse
        self._bridge = bridge
        self._traffic = traffic
        self._wake = wake
        self._token: Any = None
        self.present: set[PresenceKey] = set()
        """Who is on the mesh's side of the channel, this bridge among them."""

    async def __aenter__(self) -> Self:
        loop = asyncio.get_running_loop()
        liveliness = self._session.liveliness()
        # Before anything is accepted it must be known who else is there; the subscriber tells it some time later.
        for key in await asyncio.to_thread(self._read):
            self._joined(key)
        self._here: Any = liveliness.declare_token(str(PresenceKey(self._lighthouse, ROLE, self._bridge)))
        self._others: Any = liveliness.declare_subscriber(
            presence_selector(self._lighthouse), lambda sample: call_in_loop(loop, self._changed, sample), history=True
        )
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if not self._session.is_closed():
            for declared in (self._token, self._others, self._here):
                if declared is not None:
                    declared.undeclare()

    def show(self, *, deaf: bool) -> None:
        """This bridge can carry; `deaf` if its daemon knows nobody who listens. Takes a new turn if that is news."""
        own = self._traffic.own
        if own is not None and own.deaf == deaf:
            return
        turn = Turn(deaf, time.time_ns(), self._bridge)
        self._traffic.take_turn(turn)
        self._replace(self._session.liveliness().declare_token(turn.key(self._lighthouse)))

    def hide(self) -> None:
        """This bridge can't carry."""
        if self._traffic.own is not None:
            self._traffic.take_turn(None)
            self._replace(None)

    def _replace(self, token: Any) -> None:
        before, self._token = self._token, token
        if before is not None and not self._session.is_closed():
            before.undeclare()

    def _read(self) -> list[str]:
        answers: zenoh.handlers.FifoChannel[zenoh.Reply] = zenoh.handlers.FifoChannel(LIMIT)
        replies = self._session.liveliness().get(presence_selector(self._lighthouse), answers, timeout=TIMEOUT)
        return [str(reply.ok.key_expr) for reply in replies if reply.ok is not None]

    def _changed(self, sample: zenoh.Sample) -> None:
        key = str(sample.key_expr)
        if sample.kind == zenoh.SampleKind.PUT:
            self._joined(key)
        else:
            self._gone(key)

    def _joined(self, key: str) -> None:
        turn = turn_of(key)
        if turn is None:
            if len(self.present) < LIMIT:
                self.present.update(_presence(key))
        elif turn.bridge != self._bridge:
            self._traffic.joined(turn)

    def _gone(self, key: str) -> None:
        turn = turn_of(key)
        if turn is None:
            self.present.difference_update(_presence(key))
        elif turn.bridge != self._bridge:
            self._traffic.gone(turn)
            self._wake()


def _presence(key: str) -> tuple[PresenceKey, ...]:
    """The key, if it is in the keyspace: anybody may declare a token on any."""
    try:
        parsed = parse_key(key)
    except InvalidKey:
        return ()
    return (parsed,) if isinstance(parsed, PresenceKey) else ()
