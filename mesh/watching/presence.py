"""The agents that are present on a lighthouse's channel, and the status of each."""

from __future__ import annotations

import asyncio
import re
from typing import TYPE_CHECKING, Final, NamedTuple, TypeAlias

from mesh.watching.queries import TIMEOUT, query_all
from schemas import InvalidRecord, RpcKey, parse_address
from schemas.status import BridgeStatus, Status, bridge_status_key

if TYPE_CHECKING:
    from collections.abc import Iterable

    import zenoh

    from mesh.network import Channel

RoleStatus: TypeAlias = Status | BridgeStatus
"""The status that a role reports of itself."""

PROVIDER: Final = "provider"
BRIDGE: Final = "bridge"
BRIDGE_TURN: Final = re.compile(r"bridge-turn-.*")
"""Presence tokens by which bridges take turns; no roles."""
PATIENCE: Final = 15.0
"""Seconds after which no more peers are asked: strangers can announce many that do not reply."""
BATCH: Final = 64
"""Peers queried at the same time."""


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
    session: zenoh.Session, address: str, lighthouse: str, *, timeout: float = TIMEOUT
) -> list[RoleStatus]:
    """The status of this address in each of its roles; empty if nobody replies within `timeout` seconds.

    Of a bridge, the status for `lighthouse` (ENS name). Raises `InvalidKey`.
    """
    keys = (str(RpcKey(address, "status")), bridge_status_key(address, lighthouse))
    # Any process may reply on these keys where no router forbids it; keep statuses of this address only.
    found = _decoded(await query_all(session, keys, timeout=timeout))
    return [status for status in found if address_of(status).lower() == address.lower()]


async def statuses(
    session: zenoh.Session, channel: Channel, peers: Iterable[PresentPeer], *, timeout: float = TIMEOUT
) -> dict[PresentPeer, RoleStatus | None]:
    """The status of each peer on the channel's lighthouse; None if it does not reply within `timeout` seconds, or if
    others took `PATIENCE` seconds."""
    asked, found, until = list(peers), {}, asyncio.get_running_loop().time() + PATIENCE
    for start in range(0, len(asked), BATCH):
        if asyncio.get_running_loop().time() > until:
            break
        batch = asked[start : start + BATCH]
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
    payloads = (reply.ok.payload.to_bytes() for reply in replies if reply.ok is not None)
    return [status for payload in payloads if (status := _decoded_one(payload)) is not None]


def _decoded_one(payload: bytes) -> RoleStatus | None:
    for kind in (Status, BridgeStatus):
        try:
            return kind.decode(payload)
        except InvalidRecord:
            continue
    return None
