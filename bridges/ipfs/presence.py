"""Presence on the lighthouse's channel: the ranks of other bridges, and the announcement of this one's."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Any, Final, Self

from bridges.ipfs.publish_queue import BRIDGE_ROLE, Rank, rank_of
from mesh.network import Channel
from schemas import PresenceKey

if TYPE_CHECKING:
    from collections.abc import Callable
    from types import TracebackType

    import zenoh

    from bridges.ipfs.relay import MessageRelay

AGENT_LIMIT: Final = 1024
"""Agents that are remembered, at most."""
BRIDGE_LIMIT: Final = 64
"""Other bridges that are taken into account, at most."""


class BridgePresence:
    """Keeps `relay` informed of other bridges' ranks: `async with BridgePresence(...) as presence`.

    `bridge` is this bridge's address; `wake` is called when a message may have become this bridge's to send. Leaving
    `async with` withdraws the announcements.
    """

    def __init__(
        self, session: zenoh.Session, lighthouse: str, bridge: str, relay: MessageRelay, *, wake: Callable[[], None]
    ) -> None:
        self._session = session
        self._lighthouse = lighthouse
        self._bridge = bridge
        self._relay = relay
        self._wake = wake
        self._channel = Channel(session, lighthouse)
        self._rank_token: Any = None
        self.present: set[PresenceKey] = set()
        """The agents on the channel, this bridge included."""

    async def __aenter__(self) -> Self:
        await self._channel.__aenter__()
        # Other bridges must be known before the first message is accepted; the watch reports them only later.
        for key in await self._channel.present():
            self._appeared(key)
        self._channel.announce(BRIDGE_ROLE, self._bridge)
        self._channel.watch_presence(self._appeared, gone=self._gone)
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._replace_token(None)
        await self._channel.__aexit__(kind, error, trace)

    def announce(self, *, isolated: bool) -> None:
        """This bridge can send; `isolated` if its daemon has no peers. A change gives it a new rank."""
        own = self._relay.own
        if own is not None and own.isolated == isolated:
            return
        rank = Rank(isolated, time.time_ns(), self._bridge)
        key = PresenceKey(self._lighthouse, rank.role, self._bridge)
        self._relay.set_rank(rank)
        self._replace_token(self._session.liveliness().declare_token(str(key)))

    def withdraw(self) -> None:
        """This bridge can't send."""
        if self._relay.own is not None:
            self._relay.set_rank(None)
            self._replace_token(None)

    def _replace_token(self, token: Any) -> None:
        before, self._rank_token = self._rank_token, token
        if before is not None and not self._session.is_closed():
            before.undeclare()

    def _appeared(self, key: PresenceKey) -> None:
        rank = rank_of(key)
        if rank is None:
            if len(self.present) < AGENT_LIMIT:
                self.present.add(key)
        elif rank.bridge != self._bridge and len(self._relay.others) < BRIDGE_LIMIT:
            self._relay.bridge_joined(rank)

    def _gone(self, key: PresenceKey) -> None:
        rank = rank_of(key)
        if rank is None:
            self.present.discard(key)
        elif rank.bridge != self._bridge:
            self._relay.bridge_left(rank)
            self._wake()
