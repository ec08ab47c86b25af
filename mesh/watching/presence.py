"""Who is on a lighthouse's channel, and how each of them is."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Final, NamedTuple, TypeAlias

from mesh.watching.asking import TIMEOUT, answers
from schemas import InvalidRecord, RpcKey, parse_address
from schemas.status import BridgeStatus, Status, bridge_status_key

if TYPE_CHECKING:
    from collections.abc import Iterable

    import zenoh

    from mesh.network import Channel

How: TypeAlias = Status | BridgeStatus
"""What somebody says of itself."""

BRIDGE: Final = "bridge"
TURN: Final = re.compile(r"bridge-turn-.*")
"""Roles that are no role, but tell whose turn it is among bridges."""
AT_ONCE: Final = 64
"""Peers that are asked at the same time."""


class Peer(NamedTuple):
    """Somebody who shows that it is on the channel: its role, and its address (EIP-55)."""

    role: str
    address: str


async def present(channel: Channel) -> list[Peer]:
    """Who is on the channel now, by role and address. Anybody may show anything where no router forbids it."""
    keys = await channel.present()
    return sorted({Peer(key.role, parse_address(key.agent)) for key in keys if not TURN.fullmatch(key.role)})


async def status_of(session: zenoh.Session, address: str, lighthouse: str, *, timeout: float = TIMEOUT) -> list[How]:
    """How whoever has this address is, in each of its roles; nothing where nobody answers within `timeout` seconds.

    Of bridges the one of `lighthouse` (ENS name) is asked. Raises `InvalidKey`.
    """
    keys = (str(RpcKey(address, "status")), bridge_status_key(address, lighthouse))
    # Whoever holds an address may answer on its keys; that it speaks of itself is what is asked for.
    told = _read(await answers(session, keys, timeout=timeout))
    return [how for how in told if address_of(how).lower() == address.lower()]


async def statuses(
    session: zenoh.Session, channel: Channel, peers: Iterable[Peer], *, timeout: float = TIMEOUT
) -> dict[Peer, How | None]:
    """How each of these peers is on the channel's lighthouse; None for who does not say so within `timeout` seconds."""
    asked, found = list(peers), {}
    for start in range(0, len(asked), AT_ONCE):
        some = asked[start : start + AT_ONCE]
        keys = {_key(peer, channel.lighthouse) for peer in some}
        for how in _read(await answers(session, keys, timeout=timeout)):
            if how.lighthouse == channel.lighthouse:
                found[role_of(how), address_of(how).lower()] = how
    return {peer: found.get((peer.role, peer.address.lower())) for peer in asked}


def role_of(how: How) -> str:
    """The role in which somebody is there."""
    return how.role if isinstance(how, Status) else BRIDGE


def address_of(how: How) -> str:
    """Whose answer it is."""
    return how.address if isinstance(how, Status) else how.bridge


def _key(peer: Peer, lighthouse: str) -> str:
    if peer.role == BRIDGE:
        return bridge_status_key(peer.address, lighthouse)
    return str(RpcKey(peer.address, "status"))


def _read(payloads: Iterable[bytes]) -> list[How]:
    """Those of the answers that can be read; a newer version may answer something else."""
    return [how for payload in payloads if (how := _read_one(payload)) is not None]


def _read_one(payload: bytes) -> How | None:
    for kind in (Status, BridgeStatus):
        try:
            return kind.decode(payload)
        except InvalidRecord:
            continue
    return None
