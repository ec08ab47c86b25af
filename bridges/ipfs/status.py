"""How a bridge is, for whoever asks it over Zenoh."""

from __future__ import annotations

from collections import deque
from typing import TYPE_CHECKING, Final

from bridges.ipfs.traffic import Way  # msgspec reads the annotations
from schemas import RpcKey
from schemas.records import Record

if TYPE_CHECKING:
    from collections.abc import Callable

SERVICE: Final = "bridge/status"
"""The beginning of the key's part after `aira/agent/{bridge}/rpc/`; the lighthouse follows."""
WINDOW: Final = 10.0
"""Seconds over which a rate is taken."""


class BridgeStatus(Record, frozen=True, kw_only=True, rename="camel"):
    """How one bridge of one lighthouse is.

    The answer to a query on `aira/agent/{bridge}/rpc/bridge/status/{lighthouse}`, where `bridge` is the address in its
    presence token; each of them may be `*`.
    """

    bridge: str
    """Its address: a name of its own, or its account's."""
    lighthouse: str
    state: str
    """`connected`, `alone` (nobody listens on IPFS), `no daemon` or `no router`."""
    carries: bool
    """Whether it is its turn to carry; another bridge does otherwise."""
    api: str
    daemon: str
    """What the daemon says it is; empty before it was first reached."""
    dialect: str
    ipfs_peers: tuple[str, ...]
    """The other nodes on the topic."""
    mesh_peers: tuple[str, ...]
    """Who is on the lighthouse's channel: role and address of each."""
    losses: int
    """How often the daemon was lost."""
    last_error: str
    to_ipfs: Way
    to_mesh: Way


def status_key(bridge: str, lighthouse: str) -> str:
    """The key on which the bridge of that address answers how it is."""
    return str(RpcKey(bridge, f"{SERVICE}/{lighthouse}"))


class Rate:
    """How often something happened lately. `clock` gives seconds."""

    def __init__(self, clock: Callable[[], float]) -> None:
        self._clock = clock
        self._buckets: deque[tuple[int, int]] = deque()

    def count(self) -> None:
        """It happened."""
        second = int(self._clock())
        if self._buckets and self._buckets[-1][0] == second:
            self._buckets[-1] = (second, self._buckets[-1][1] + 1)
        else:
            self._buckets.append((second, 1))
            self._trim()

    def per_second(self) -> float:
        """The mean of the last `WINDOW` seconds."""
        self._trim()
        return sum(count for _, count in self._buckets) / WINDOW

    def _trim(self) -> None:
        while self._buckets and self._buckets[0][0] <= self._clock() - WINDOW:
            self._buckets.popleft()
