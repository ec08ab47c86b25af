"""What a process tells about itself over Zenoh: its status, and its log.

Agents, providers, bridges and edge agents answer the services `status` and `logs` (see `schemas.rpc`), bridges a query
on `bridge_status_key`. A log event as a JSON line on stderr has the same fields. Readers ignore unknown fields, because
different versions talk to each other here.
"""

from __future__ import annotations

from collections.abc import Mapping  # msgspec reads the annotations
from typing import Final

import msgspec

from schemas.keys import RpcKey
from schemas.records import Record, UInt256

LEVELS: Final = ("debug", "info", "warning", "error", "critical")
"""The levels, in ascending order."""


class LogEvent(Record, frozen=True, kw_only=True, omit_defaults=True, forbid_unknown_fields=False):
    """One event of a log. Empty fields are not sent."""

    sequence: int = 0
    """Its number in the log of its process, from 1."""
    time: str
    """ISO 8601, UTC, with milliseconds and `Z`."""
    level: str
    """One of `LEVELS`."""
    logger: str
    """The module that logged it."""
    event: str = ""
    """The stable name of what happened (`contract-created`), for programs; empty for other programs' lines."""
    message: str
    role: str = ""
    """The role of the process: agent, provider, router, bridge, edge."""
    address: str = ""
    """The account of the process (EIP-55)."""
    lighthouse: str = ""
    liability: str = ""
    """The contract that it concerns (EIP-55)."""
    facts: Mapping[str, str] = {}
    """Further fields by name; in a JSON line they are members of the event itself."""
    error: str = ""
    """The exception, in one line."""
    trace: str = ""
    """Its traceback, with line breaks."""


class ReadLogs(Record, frozen=True, kw_only=True):
    """A request for events, the oldest first."""

    after: Mapping[str, int] = {}
    """The sequence number of the last event that the caller has, by instance."""
    lines: int = 100
    """How many of the newest events to return from an instance that is not in `after`."""
    level: str = "debug"
    """The lowest level to return, one of `LEVELS`."""
    liability: str = ""
    """Return only events that concern this contract (empty: all)."""


class LogsRead(Record, frozen=True, kw_only=True, forbid_unknown_fields=False):
    """The reply: as many events as fit."""

    instance: str
    """An id of this run of the process; it changes at a restart."""
    began: str
    """When this run started; as `LogEvent.time`."""
    role: str = ""
    entries: tuple[LogEvent, ...] = ()
    last: int
    """The sequence number to continue from."""
    more: bool = False
    """Whether there are more events now."""
    missed: int = 0
    """How many of the requested events are no longer in memory."""


ALIVE: Final = "alive"
"""The state of a part that works."""
OFF: Final = "off"
"""The state of a part that is switched off by the settings."""
BRIDGE_SERVICE: Final = "bridge/status"
"""The service of a bridge's status, in `aira/agent/{bridge}/rpc/…`, before the lighthouse."""


class StoreUse(Record, frozen=True, kw_only=True, forbid_unknown_fields=False):
    """The use of an agent's content store, in bytes; `quota` is the limit."""

    files: int
    bytes: int
    quota: int | None = None


class Work(Record, frozen=True, kw_only=True, rename="camel", forbid_unknown_fields=False):
    """An agent's work: its jobs by phase, the messages in its outbox, its store."""

    jobs: Mapping[str, int]
    outbox: int
    store: StoreUse


class MarketStatus(Record, frozen=True, kw_only=True, rename="camel", forbid_unknown_fields=False):
    """A provider's market since it started: open orders, contracts, rejected messages by reason, amounts.

    `fees` and `minted` (XRT for gas) are in wn, `spent` is in wei. Of the contracts that don't cover their gas,
    `free_created` were created; `free_a_day` may be a day, for others than customers, and `free_left` now.
    """

    open_orders: int
    created: int
    finalized: int
    rejected: Mapping[str, int]
    gas_used: int
    spent: UInt256
    fees: UInt256
    minted: UInt256
    free_a_day: int = 0
    free_left: int = 0
    free_created: int = 0


class ValidationStatus(Record, frozen=True, kw_only=True, rename="camel", forbid_unknown_fields=False):
    """A validator's work: the addresses that it judges for, its policies, its liabilities by stage, its store.

    `fee` is the least fee for which it judges, in wn.
    """

    validators: tuple[str, ...]
    policies: tuple[str, ...]
    fee: UInt256
    cases: Mapping[str, int]
    store: StoreUse


class Status(Record, frozen=True, kw_only=True, rename="camel", forbid_unknown_fields=False):
    """The status of an agent, a provider or a validator (service `status`).

    Agents report `work`, providers `market`, validators `validation`. One account may run several of them: then each
    one answers.
    """

    role: str
    """`agent`, `provider` or `validator`."""
    address: str
    """The address of its account, EIP-55."""
    version: str
    zenoh_id: str
    lighthouse: str
    """The ENS name of its market."""
    parts: Mapping[str, str]
    """The state of each part: `ALIVE`, `OFF`, or in a few words what it is waiting for."""
    head: int
    """The last block that it has processed."""
    chain_id: int
    xrt: str = ""
    """The address of the token of fees and stakes, EIP-55."""
    uptime: float = 0.0
    """Seconds since it started."""
    work: Work | None = None
    market: MarketStatus | None = None
    validation: ValidationStatus | None = None
    model: str = ""
    """A robot's model, a CIDv0, if it has one; empty for the programs of people who order."""
    dropped: Mapping[str, int] = {}
    """What it dropped since it started because there was too much of it, by reason."""
    heaviest: Mapping[str, Mapping[str, int]] = {}
    """The senders from whom it dropped most in the last minute, by reason, with estimated counts."""


class DirectionStatus(msgspec.Struct, frozen=True, kw_only=True, rename="camel"):
    """The counters of one direction of a bridge since it started; `per_second` is over the last ten seconds."""

    received: int
    invalid: Mapping[str, int]
    """Messages rejected, by reason."""
    known: int
    """Valid messages that were already on the other side: echoes, repetitions, those of another bridge."""
    accepted: int
    carried: int
    """Carried by this bridge."""
    left: int
    """Carried by another bridge."""
    dropped: Mapping[str, int]
    """Lost, by reason: `no-room`, `refused` by the other side, `unseen` by a reader that was too slow, `unheard`."""
    waiting: int
    left_waiting: int
    unheard: int
    per_second: float
    kinds: Mapping[str, int] = {}
    """Accepted, by kind: demand, offer, result, feedback, pending."""
    bytes: int = 0
    """Bytes of the messages that this bridge has carried."""


class ContentMetrics(msgspec.Struct, frozen=True, kw_only=True, rename="camel"):
    """The content that a bridge has transferred since it started, for all its lighthouses."""

    fetched: int
    """Files fetched from IPFS and kept."""
    fetched_bytes: int
    """Bytes of all blocks from IPFS that matched their CID."""
    lies: int
    """Blocks from IPFS that did not match their CID."""
    answered: int
    """Blocks of IPFS sent to the mesh in answer to queries."""
    added: int
    """Files of the mesh added to IPFS."""
    added_bytes: int
    by_blocks: int
    """Those of them added block by block, because the daemon would give them another CID."""
    pinned: int
    """Files pinned by further nodes, counted once for each node."""
    failed: int
    """Files that neither side could provide, that could not be added, or for which the queue had no room."""
    joined: int = 0
    """Files not transferred once more, because another transfer of the same served."""
    adds_queued: int = 0
    """Files that wait to be added to IPFS."""
    fetches_queued: int = 0
    """Files that wait to be fetched from IPFS."""


class BridgeStatus(Record, frozen=True, kw_only=True, rename="camel", forbid_unknown_fields=False):
    """The status of one bridge of one lighthouse.

    It answers a query on `aira/agent/{bridge}/rpc/bridge/status/{lighthouse}`, where `bridge` is the address in its
    presence token; either may be `*`.
    """

    bridge: str
    """Its address: a generated one, or that of its account."""
    lighthouse: str
    state: str
    """`connected`, `alone` (no other node on the topic), `no daemon` or `no router`."""
    carries: bool
    """Whether this bridge carries messages, or leaves them to another one."""
    api: str
    daemon: str
    """The daemon's name and version; empty before it was first reached."""
    dialect: str
    ipfs_peers: tuple[str, ...]
    """The other nodes on the topic."""
    mesh_peers: tuple[str, ...]
    """The peers on the lighthouse's channel: role and address of each."""
    losses: int
    """How often the connection to the daemon was lost."""
    last_error: str
    to_ipfs: DirectionStatus
    to_mesh: DirectionStatus
    content: ContentMetrics | None = None
    uptime: float = 0.0
    """Seconds since it started."""
    dropped: Mapping[str, int] = {}
    """What its process dropped since it started because there was too much of it, by reason."""
    heaviest: Mapping[str, Mapping[str, int]] = {}
    """The senders from whom it dropped most in the last minute, by reason, with estimated counts."""


def bridge_status_key(bridge: str, lighthouse: str) -> str:
    """The key on which the bridge with that address reports its status."""
    return str(RpcKey(bridge, f"{BRIDGE_SERVICE}/{lighthouse}"))
