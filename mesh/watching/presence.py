"""The agents that are present on a lighthouse's channel: the status and the log of each."""

from __future__ import annotations

import asyncio
import re
from contextlib import suppress
from typing import TYPE_CHECKING, Final, NamedTuple, TypeAlias

from mesh.network.services import Failure, ServiceFailed
from mesh.watching.market import QUERY_LIMITS, query_all
from schemas import InvalidRecord, RpcKey, parse_address
from schemas.status import BridgeStatus, LogsRead, ReadLogs, Status, bridge_status_key

if TYPE_CHECKING:
    from collections.abc import Iterable

    import zenoh

    from mesh.network import Channel
    from schemas.status import LogEvent


RoleStatus: TypeAlias = Status | BridgeStatus
"""The status that a role reports of itself."""

PROVIDER: Final = "provider"
BRIDGE: Final = "bridge"
BRIDGE_TURN: Final = re.compile(r"bridge-turn-.*")
"""Presence tokens by which bridges take turns; no roles."""


class PeerQueryLimits(NamedTuple):
    """How many of those that are present are asked."""

    patience: float = 15.0
    """Seconds after which no more peers are asked: strangers can announce many that do not reply."""
    batch: int = 64
    """Peers queried at the same time."""


PEER_LIMITS: Final = PeerQueryLimits()


class PresentPeer(NamedTuple):
    """An agent announced on the channel: its role and its address (EIP-55)."""

    role: str
    address: str


class PresenceChange(NamedTuple):
    """An agent has appeared on the channel, or is gone."""

    peer: PresentPeer
    is_present: bool


async def present(channel: Channel, *roles: str) -> list[PresentPeer]:
    """The agents announced on the channel now, in these roles or in all: at most `PRESENT_LIMIT` for each.

    Not verified: only a router with a roster restricts announcements.
    """
    keys = [key for role in roles or ("*",) for key in await channel.present(role)]
    return sorted(
        {PresentPeer(key.role, parse_address(key.agent)) for key in keys if not BRIDGE_TURN.fullmatch(key.role)}
    )


async def status_of(
    session: zenoh.Session, address: str, lighthouse: str, *, timeout: float = QUERY_LIMITS.timeout
) -> list[RoleStatus]:
    """The status of this address in each of its roles; empty if nobody replies within `timeout` seconds.

    Of a bridge, the status for `lighthouse` (ENS name). Raises `InvalidKey`.
    """
    keys = (str(RpcKey(address, "status")), bridge_status_key(address, lighthouse))
    # Any process may reply on these keys where no router forbids it; keep statuses of this address only.
    found = _decoded(await query_all(session, keys, timeout=timeout))
    return [status for status in found if address_of(status).lower() == address.lower()]


async def statuses(
    session: zenoh.Session, channel: Channel, peers: Iterable[PresentPeer], *, timeout: float = QUERY_LIMITS.timeout
) -> dict[PresentPeer, RoleStatus | None]:
    """The status of each peer on the channel's lighthouse; None if it does not reply within `timeout` seconds, or if
    others took `PEER_LIMITS.patience` seconds."""
    asked, found, until = list(peers), {}, asyncio.get_running_loop().time() + PEER_LIMITS.patience
    for start in range(0, len(asked), PEER_LIMITS.batch):
        if asyncio.get_running_loop().time() > until:
            break
        batch = asked[start : start + PEER_LIMITS.batch]
        keys = {_key(peer, channel.lighthouse) for peer in batch}
        for status in _decoded(await query_all(session, keys, timeout=timeout)):
            if status.lighthouse == channel.lighthouse:
                found[role_of(status), address_of(status).lower()] = status
    return {peer: found.get((peer.role, peer.address.lower())) for peer in asked}


def role_of(status: RoleStatus) -> str:
    """The role that a status is of."""
    return status.role if isinstance(status, Status) else BRIDGE


def address_of(status: RoleStatus) -> str:
    """The address that a status is of."""
    return status.address if isinstance(status, Status) else status.bridge


def _key(peer: PresentPeer, lighthouse: str) -> str:
    if peer.role == BRIDGE:
        return bridge_status_key(peer.address, lighthouse)
    return str(RpcKey(peer.address, "status"))


def _decoded(replies: Iterable[zenoh.Reply]) -> list[RoleStatus]:
    """The statuses in these replies. Others are ignored: a newer version may reply something else."""
    found: list[RoleStatus] = []
    for payload in (reply.ok.payload.to_bytes() for reply in replies if reply.ok is not None):
        for kind in (Status, BridgeStatus):
            with suppress(InvalidRecord):
                found.append(kind.decode(payload))
                break
    return found


class LogUpdate(NamedTuple):
    """The new events since the last poll."""

    events: list[LogEvent]
    """In order of time."""
    answered: bool = False
    more: bool = False
    """Whether there are more events already."""
    missed: int = 0
    """Events that were dropped before they could be read."""
    began: tuple[str, ...] = ()
    """Start times of processes that were not there at the last poll."""


class LogReader:
    """Reads the log served on `key`, from its last `lines` events on: call `poll` repeatedly.

    Several processes may reply, such as an agent and a provider of one account; each is followed separately. `level` is
    the lowest level, `liability` the contract that events are about (empty: any).
    """

    def __init__(
        self, session: zenoh.Session, key: str, *, lines: int, level: str = "debug", liability: str = ""
    ) -> None:
        self._session = session
        self._key = key
        self._wanted = ReadLogs(lines=lines, level=level, liability=liability)
        self._after: dict[str, int] = {}

    @property
    def instances(self) -> frozenset[str]:
        """The processes whose logs are followed."""
        return frozenset(self._after)

    async def poll(self, *, timeout: float = QUERY_LIMITS.timeout) -> LogUpdate:
        """The events since the last poll. Raises `ServiceFailed` if all replies are errors."""
        first = not self._after
        found, failures = await self._query(timeout)
        if not found and failures:
            raise ServiceFailed(f"logs: {failures[0].error}", service="logs", hint=failures[0].hint)
        events: list[LogEvent] = []
        missed, began = 0, []
        for reply in found:
            if reply.instance in self._after:
                missed += reply.missed
            elif not first:
                began.append(reply.began)
            self._after[reply.instance] = reply.last
            events += reply.entries
        # Python's sort is stable: the events of one process keep their order.
        events.sort(key=lambda event: event.time)
        more = any(reply.more for reply in found)
        return LogUpdate(events, answered=bool(found), more=more, missed=missed, began=tuple(began))

    async def _query(self, timeout: float) -> tuple[list[LogsRead], list[Failure]]:
        wanted = self._wanted
        lines = 1_000_000 if self._after else wanted.lines  # of a process that started meanwhile all that it keeps
        request = ReadLogs(after=self._after, lines=lines, level=wanted.level, liability=wanted.liability)
        found: dict[str, LogsRead] = {}
        failures = []
        for reply in await query_all(self._session, [self._key], payload=request.encode(), timeout=timeout):
            try:
                if reply.ok is not None:
                    # A process may reply twice: for two markets with one account.
                    read = LogsRead.decode(reply.ok.payload.to_bytes())
                    found.setdefault(read.instance, read)
                elif reply.err is not None:
                    failures.append(Failure.decode(reply.err.payload.to_bytes()))
            except InvalidRecord as error:
                if reply.ok is not None:  # Zenoh's own error says `Timeout`, which is no record
                    failures.append(Failure(f"the answer can't be read: {error}"))
        return list(found.values()), failures
