"""The status of a bridge: made up for tests, or read over HTTP."""

from __future__ import annotations

import json
import urllib.error
import urllib.request
from typing import Any

from schemas.status import BridgeStatus, DirectionStatus

ZERO: dict[str, Any] = dict.fromkeys(
    ("received", "known", "accepted", "carried", "left", "waiting", "left_waiting", "unheard"), 0
)


def direction(**counts: Any) -> DirectionStatus:
    """One direction, all zero but for `counts`."""
    return DirectionStatus(**(ZERO | {"invalid": {}, "dropped": {}, "per_second": 0.5} | counts))


def status(**counts: Any) -> BridgeStatus:
    """An active bridge that is connected."""
    rest: dict[str, Any] = dict.fromkeys(("api", "daemon", "dialect", "last_error"), "")
    rest |= {"bridge": "0x", "lighthouse": "l", "state": "connected", "carries": True, "losses": 0}
    rest |= {"ipfs_peers": (), "mesh_peers": (), "to_ipfs": direction(), "to_mesh": direction()}
    return BridgeStatus(**(rest | counts))


SECONDS = 60.0


def health(port: int) -> tuple[int, dict[str, str]]:
    """The status code of `/health`, and the parts."""
    try:
        with urllib.request.urlopen(f"http://127.0.0.1:{port}/health", timeout=SECONDS) as answer:
            return answer.status, json.load(answer)["parts"]
    except urllib.error.HTTPError as answer:
        with answer:
            return answer.code, json.load(answer)["parts"]


def metrics(port: int) -> str:
    """The page of metrics."""
    with urllib.request.urlopen(f"http://127.0.0.1:{port}/metrics", timeout=SECONDS) as answer:
        text: str = answer.read().decode()
        return text
