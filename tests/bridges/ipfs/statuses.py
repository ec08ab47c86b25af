"""What a bridge says of itself, made up for tests: all zero but for what a test names."""

from __future__ import annotations

from typing import Any

from schemas.status import BridgeStatus, DirectionStatus

NONE: dict[str, Any] = dict.fromkeys(
    ("received", "known", "accepted", "carried", "left", "waiting", "left_waiting", "unheard"), 0
)


def way(**figures: Any) -> DirectionStatus:
    """One direction."""
    return DirectionStatus(**(NONE | {"invalid": {}, "dropped": {}, "per_second": 0.5} | figures))


def status(**figures: Any) -> BridgeStatus:
    """A bridge that is connected and carries."""
    rest: dict[str, Any] = dict.fromkeys(("api", "daemon", "dialect", "last_error"), "")
    rest |= {"bridge": "0x", "lighthouse": "l", "state": "connected", "carries": True, "losses": 0}
    rest |= {"ipfs_peers": (), "mesh_peers": (), "to_ipfs": way(), "to_mesh": way()}
    return BridgeStatus(**(rest | figures))
