"""How an agent, a provider or a bridge is: what each answers who asks it over Zenoh.

Agents and providers answer the service `status` (see `schemas.rpc`), bridges a query on `bridge_status_key`. These
records may have fields that a reader does not know yet: versions meet here.
"""

from __future__ import annotations

from collections.abc import Mapping  # msgspec reads the annotations
from typing import Final

import msgspec

from schemas.keys import RpcKey
from schemas.records import Record, UInt256

ALIVE: Final = "alive"
"""The state of a part that does what it is for."""
OFF: Final = "off"
"""The state of a part that the settings switch off."""
BRIDGE_SERVICE: Final = "bridge/status"
"""The beginning of the key's part after `aira/agent/{bridge}/rpc/`; the lighthouse follows."""


class StoreUse(Record, frozen=True, kw_only=True, forbid_unknown_fields=False):
    """How much of its content store an agent uses; `quota` (bytes) is the most."""

    files: int
    bytes: int
    quota: int | None = None


class Work(Record, frozen=True, kw_only=True, rename="camel", forbid_unknown_fields=False):
    """An agent's work: its jobs by phase, the messages that it sends until their effect is seen, its store."""

    jobs: Mapping[str, int]
    outbox: int
    store: StoreUse


class MarketStatus(Record, frozen=True, kw_only=True, rename="camel", forbid_unknown_fields=False):
    """A provider's market since it began: open orders, contracts, messages rejected by reason, money.

    `fees` and `minted` (XRT for gas) are in wn, `spent` is in wei.
    """

    open_orders: int
    created: int
    finalized: int
    rejected: Mapping[str, int]
    gas_used: int
    spent: UInt256
    fees: UInt256
    minted: UInt256


class Status(Record, frozen=True, kw_only=True, rename="camel", forbid_unknown_fields=False):
    """How an agent or a provider is (`status`).

    `work` is an agent's, `market` a provider's. One account may be both, and on several lighthouses: then each answers.
    """

    role: str
    """`agent` or `provider`."""
    address: str
    """Of its account, EIP-55."""
    version: str
    zenoh_id: str
    lighthouse: str
    """The ENS name of its market."""
    parts: Mapping[str, str]
    """The state of each part: `ALIVE`, `OFF`, or in a few words what it waits for."""
    head: int
    """The last block that it has handled."""
    chain_id: int
    xrt: str = ""
    """The address of the token of fees and stakes, EIP-55."""
    uptime: float = 0.0
    """Seconds since it began."""
    work: Work | None = None
    market: MarketStatus | None = None


class DirectionStatus(msgspec.Struct, frozen=True, kw_only=True, rename="camel"):
    """One direction of a bridge in figures. Counts are since it started; `per_second` is over the last ten seconds."""

    received: int
    invalid: Mapping[str, int]
    """Not let through, by reason."""
    known: int
    """Let through and on the far side already: echoes, repetitions, what another bridge brought."""
    accepted: int
    carried: int
    """Carried by this bridge."""
    left: int
    """Carried by another one."""
    dropped: Mapping[str, int]
    """Lost, by reason: `no-room`, `refused` by the far side, `unseen` for a reader that was too slow, `unheard`."""
    waiting: int
    left_waiting: int
    unheard: int
    per_second: float
    kinds: Mapping[str, int] = {}
    """Accepted, by kind: demand, offer, result, feedback, pending."""
    bytes: int = 0
    """Of the messages that this bridge has carried."""


class ContentMetrics(msgspec.Struct, frozen=True, kw_only=True, rename="camel"):
    """What a bridge has done with content since it started, on all its lighthouses together."""

    fetched: int
    """Files fetched from IPFS and kept."""
    fetched_bytes: int
    """Of all blocks that came from IPFS and were what they should be."""
    lies: int
    """Blocks that came from IPFS and were not."""
    answered: int
    """Blocks of IPFS given to who asked for them in the mesh."""
    added: int
    """Files of the mesh added to IPFS."""
    added_bytes: int
    by_blocks: int
    """Those of them that the daemon would name otherwise, and was given block by block."""
    pinned: int
    """Files that further nodes have pinned, once for each node."""
    failed: int
    """Files that could be had from neither side, or not added."""


class BridgeStatus(Record, frozen=True, kw_only=True, rename="camel", forbid_unknown_fields=False):
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
    to_ipfs: DirectionStatus
    to_mesh: DirectionStatus
    content: ContentMetrics | None = None
    uptime: float = 0.0
    """Seconds since it began."""


def bridge_status_key(bridge: str, lighthouse: str) -> str:
    """The key on which the bridge of that address answers how it is."""
    return str(RpcKey(bridge, f"{BRIDGE_SERVICE}/{lighthouse}"))
