"""Relayed messages: validated, and in the JSON of legacy clients; and the relay between the two channels, where each
message is sent by one bridge, and again only if its sender repeats it.

A message that is seen on one side and not known on the other waits in the publish queue to the other. IPFS nodes drop
messages without a report; so what its sender repeats is relayed again after a while, by `REPETITION`.

Several bridges may serve one lighthouse. Each has a presence token with its rank for as long as it can send; the one
with the lowest is active. The others stand by: they hold what they receive until they see it on the other side, and
send what they still hold when they become active. A bridge whose daemon has no peers ranks behind one whose daemon has
some; otherwise the longest-running one is first, so a new one takes over nothing.
"""

from __future__ import annotations

import logging
import os
import time
from collections import Counter, OrderedDict
from enum import Enum
from hashlib import sha256
from typing import TYPE_CHECKING, Any, Final, NamedTuple, Self, TypeAlias

import msgspec

from mesh.base.database import DISK_ERRORS, SyncedDatabase
from mesh.base.flood import BoundedDict
from mesh.base.log_context import log_event
from mesh.base.private_files import make_private_folder, open_private, try_lock
from mesh.base.retry import RetryPolicy
from mesh.errors import AiraError, ConfigurationError, InvalidMessage
from mesh.market.store import Withdrawals
from schemas import Demand, Message, Offer, OrderFeedback, Result, address_bytes, decode, encode
from schemas.keys import KINDS, market_key, market_kind
from schemas.status import DirectionStatus

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path

    from mesh.network import MarketRules
    from schemas import PresenceKey, Verified

log = logging.getLogger(__name__)

LARGEST_LEGACY: Final = 2**32 - 1
"""The largest amount or deadline that the legacy nodes of generation 3 can hold."""
_LEGACY_FIELDS: Final[dict[tuple[type[Message], int], tuple[tuple[str, str], ...]]] = {}
"""Kind and generation → (attribute, field on the wire), in the order in which legacy clients wrote them."""


def _legacy_order(kind: type[Message], generation: int, names: str) -> None:
    attributes = {field.encode_name: field.name for field in msgspec.structs.fields(kind)}
    _LEGACY_FIELDS[kind, generation] = tuple((attributes[name], name) for name in names.split())


_legacy_order(Demand, 3, "model objective token cost validator lighthouse deadline nonce signature validatorFee")
_legacy_order(Offer, 3, "model objective token cost validator lighthouse deadline nonce signature lighthouseFee")
_legacy_order(Demand, 5, "model objective token cost lighthouse validator validatorFee deadline sender nonce signature")
_legacy_order(Offer, 5, "model objective token cost validator lighthouse lighthouseFee deadline sender nonce signature")
_legacy_order(Result, 0, "liability result success signature")
_legacy_order(OrderFeedback, 0, "order accepted signature")


def legacy_json(message: Message) -> bytes:
    """The JSON of a message byte for byte as legacy clients wrote it: compact, with the fields in their order.

    Readers should not depend on the order, but some may. Raises `InvalidMessage` (`signature`) for an unsigned message
    of a signed kind.
    """
    generation = message.generation if isinstance(message, Demand | Offer) else 0
    fields = _LEGACY_FIELDS.get((type(message), generation), (("tx", "tx"),))
    if not getattr(message, "signature", "transaction feedback is unsigned"):
        raise InvalidMessage("signature", "the message is not signed")
    return msgspec.json.encode({name: getattr(message, attribute) for attribute, name in fields})


class RelayMessage(NamedTuple):
    """A valid message. Its fingerprint is the same on both sides, whatever the encoding.

    `key` and `payload` are for the mesh, `legacy` is the JSON for IPFS. A signed message has a `hash` (64 hexadecimal
    digits) and a `signer` (EIP-55).
    """

    fingerprint: bytes
    key: str
    payload: bytes
    legacy: bytes
    hash: str = ""
    signer: str = ""

    @property
    def kind(self) -> str:
        """The kind in its key: demand, offer, result, feedback or pending."""
        return market_kind(self.key)

    @property
    def order(self) -> bytes:
        """The identity by which a withdrawal of this order is known."""
        return bytes.fromhex(self.hash) + address_bytes(self.signer) if self.signer else b""


class RelayValidator:
    """Validates the messages of one lighthouse by the `rules` of its market: `await validator.validate(payload)`.

    `withdrawals` are those known: their orders are not relayed. Without `large_numbers`, neither are orders of
    generation 3 from the mesh whose amounts or deadline have more than 32 bits: legacy nodes that meet one hear nothing
    more.
    """

    def __init__(
        self, rules: MarketRules, *, withdrawals: Withdrawals | None = None, large_numbers: bool = False
    ) -> None:
        self.rules: Final = rules
        self.withdrawals: Final = Withdrawals() if withdrawals is None else withdrawals
        self._large_numbers = large_numbers
        self.on_too_large: Callable[[Verified[Demand | Offer], str], None] = lambda order, why: None
        """Called with an order that has such numbers, and why it is rejected."""

    async def validate(self, payload: bytes, *, key: str | None = None) -> RelayMessage:
        """The message in `payload`: well-formed, for this market, before its deadline, correctly signed.

        `key`, if given, must be the one that the message requires. The signature of order feedback is not verified,
        because what it covers is undocumented. Raises only `InvalidMessage`; its `reason` is one of `schemas.decode`
        or `MarketRules.verified`, or `withdrawn`, `too-large`, and `kind` for a message that the legacy network does
        not have.
        """
        message = decode(payload)
        if not KINDS[message.kind].is_legacy:
            raise InvalidMessage("kind", f"the legacy network has no message of the kind {message.kind}")
        canonical = encode(message)
        own_key = market_key(self.rules.lighthouse, message.kind, message.key_model)
        digest = signer = ""
        if isinstance(message, Demand | Offer | Result):
            verified = await self.rules.verified(message, key)
            digest, signer = verified.hash.hex(), verified.signer
            if key is not None and not self._large_numbers:
                self._check_numbers(verified)
        elif key is not None and key != own_key:
            raise InvalidMessage("key", f"the message does not belong on {key}")
        fingerprint = sha256(canonical).digest()[:16]
        relayed = RelayMessage(fingerprint, own_key, canonical, legacy_json(message), digest, signer)
        if relayed.order in self.withdrawals:
            raise InvalidMessage("withdrawn", "its maker has withdrawn it")
        return relayed

    def _check_numbers(self, verified: Verified[Any]) -> None:
        """Raise `InvalidMessage` for an order that older legacy nodes can't hold; the log says whose it is."""
        order, signer = verified.message, verified.signer
        if not isinstance(order, Demand | Offer) or order.generation != 3:
            return
        fee = order.validator_fee if isinstance(order, Demand) else order.lighthouse_fee
        if max(order.cost, fee, order.deadline) > LARGEST_LEGACY:
            why = f"cost, fee and deadline are at most {LARGEST_LEGACY:,} on the legacy network of generation 3"
            too_large = log_event("order-too-large", signer=signer)
            log.warning("an order of %s is not passed on to IPFS: %s", signer, why, extra=too_large)
            self.on_too_large(verified, why)
            raise InvalidMessage("too-large", why)


class RelayLimits(NamedTuple):
    """What a bridge remembers and keeps of messages."""

    window: float = 600.0
    """Seconds for which a message that was seen on a side is known to be there, and for which a standby holds one."""
    remembered: int = 131_072
    """Messages remembered per side; the oldest are forgotten first."""
    waiting: int = 10_000
    """Messages that wait in one direction; about 15 MB."""


RELAY_LIMITS: Final = RelayLimits()
REPETITION: Final = RetryPolicy(initial=60.0, ceiling=RELAY_LIMITS.window)
"""How long after a message was relayed a copy from its own side is relayed again: its sender still waits for an effect,
so the message may have been lost on the way, or nobody who could use it had joined yet."""
BRIDGE_ROLE: Final = "bridge"
"""The role under which a bridge announces its presence, whether or not it can send."""
_RANK_ROLE: Final = "bridge-turn-"

Rank: TypeAlias = tuple[str, str]
"""A bridge's place: the role and the address in its token. The lowest is active."""


def rank_for(*, isolated: bool, since_ns: int, bridge: str) -> Rank:
    """The rank of a bridge (address) that can send since a time; `isolated`: its daemon has no peers on the topic."""
    return f"{_RANK_ROLE}{int(isolated)}-{since_ns:016x}", bridge


def rank_of(key: PresenceKey) -> Rank | None:
    """The rank that a presence token announces; None if it announces something else."""
    return (key.role, key.agent) if key.role.startswith(_RANK_ROLE) else None


class Side(Enum):
    MESH = "mesh"
    IPFS = "ipfs"

    @property
    def other(self) -> Side:
        return Side.IPFS if self is Side.MESH else Side.MESH


class QueuedMessage(NamedTuple):
    """A message that waits since a time, in seconds of the relay's clock."""

    message: RelayMessage
    since: float


class PublishQueue:
    """Up to `limit` orders, and as many other messages, in turn: a flood of orders does not delay results."""

    def __init__(self, *, limit: int) -> None:
        self._limit = limit
        self._orders: OrderedDict[bytes, QueuedMessage] = OrderedDict()
        self._others: OrderedDict[bytes, QueuedMessage] = OrderedDict()
        self._orders_next = False

    def __len__(self) -> int:
        return len(self._orders) + len(self._others)

    def __contains__(self, fingerprint: bytes) -> bool:
        return fingerprint in self._orders or fingerprint in self._others

    def __iter__(self) -> Iterator[QueuedMessage]:
        yield from self._orders.values()
        yield from self._others.values()

    def add(self, queued: QueuedMessage, *, first: bool = False) -> bool:
        """Accept a message; False if the queue is full. The `first` one goes before all others, and always fits."""
        own = self._orders if queued.message.kind in ("demand", "offer") else self._others
        if len(own) >= self._limit and not first:
            return False
        own[queued.message.fingerprint] = queued
        own.move_to_end(queued.message.fingerprint, last=not first)
        return True

    def next(self) -> QueuedMessage | None:
        """The oldest message of the kind whose turn it is; it stays in the queue."""
        first, second = (self._orders, self._others) if self._orders_next else (self._others, self._orders)
        return next(iter((first or second).values()), None)

    def pop(self, fingerprint: bytes) -> QueuedMessage | None:
        """Remove a message; it is the other kind's turn then. None if it is not here."""
        for own in (self._others, self._orders):
            if (queued := own.pop(fingerprint, None)) is not None:
                self._orders_next = own is self._others
                return queued
        return None


class SeenMessages:
    """The fingerprints of messages seen on each side within the deduplication window, and of those relayed there: how
    often, and when last. `clock` returns seconds."""

    def __init__(self, clock: Callable[[], float]) -> None:
        self._clock = clock
        self._seen = {side: BoundedDict[bytes, float](RELAY_LIMITS.remembered) for side in Side}
        self._relayed = {side: BoundedDict[bytes, tuple[int, float]](RELAY_LIMITS.remembered) for side in Side}

    def add(self, fingerprint: bytes, side: Side, *, age: float = 0.0) -> None:
        """The message was on `side` `age` seconds ago. Adding it again keeps the first time."""
        if not self.contains(fingerprint, side):
            self._seen[side][fingerprint] = self._clock() - age

    def contains(self, fingerprint: bytes, side: Side) -> bool:
        """Whether the message was seen on that side within the window."""
        seen = self._seen[side].get(fingerprint)
        return seen is not None and self._clock() - seen < RELAY_LIMITS.window

    def add_relayed(self, fingerprint: bytes, side: Side) -> None:
        """The message was relayed to that side now."""
        times, _ = self._relayed[side].get(fingerprint, (0, 0.0))
        self._relayed[side][fingerprint] = times + 1, self._clock()

    def needs(self, fingerprint: bytes, side: Side) -> bool:
        """Whether a message from the other side is to be relayed: it is not there, or its sender repeats it."""
        if (relayed := self._relayed[side].get(fingerprint)) is None:
            return not self.contains(fingerprint, side)
        times, at = relayed
        return self._clock() - at >= REPETITION.delay(times)

    def __len__(self) -> int:
        """The number of messages remembered, where there are most."""
        return max(*map(len, self._seen.values()), *map(len, self._relayed.values()))


_DELETE: Final = "DELETE FROM waiting WHERE fingerprint = ?"


class RelayJournal:
    """The SQLite file of one bridge: `with RelayJournal(path) as journal`.

    Writes survive `kill -9`; a power failure may lose the last moments. Calls take tens of microseconds and run on the
    event loop. Raises `ConfigurationError` when another bridge uses the file, and `AiraError` (`journal-failed`).
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._database = SyncedDatabase(
            path,
            """
            CREATE TABLE IF NOT EXISTS crossed (fingerprint BLOB PRIMARY KEY, at REAL NOT NULL) WITHOUT ROWID;
            CREATE TABLE IF NOT EXISTS waiting (
                fingerprint BLOB, key TEXT, payload BLOB, legacy BLOB, hash TEXT, signer TEXT, side TEXT,
                PRIMARY KEY (fingerprint, side));
            """,
        )

    def __enter__(self) -> Self:
        try:
            make_private_folder(self._path.parent)
            self._lock = open_private(self._path.with_suffix(".lock"), os.O_RDWR | os.O_CREAT)
        except OSError as error:
            raise ConfigurationError(f"can't write a journal in {self._path.parent}: {error.strerror}") from None
        try:
            self._open()
        except BaseException:
            os.close(self._lock)
            raise
        return self

    def __exit__(self, *exc_info: object) -> None:
        self._database.close()
        os.close(self._lock)

    def add_waiting(self, to: Side, message: RelayMessage) -> None:
        """The message waits to be sent to side `to`."""
        self._write(("INSERT OR REPLACE INTO waiting VALUES (?, ?, ?, ?, ?, ?, ?)", [(*message, to.value)]))

    def mark_relayed(self, fingerprint: bytes) -> None:
        """The message is on both sides."""
        crossed = "INSERT OR REPLACE INTO crossed VALUES (?, ?)"
        self._write((crossed, [(fingerprint, time.time())]), (_DELETE, [(fingerprint,)]))

    def remove_waiting(self, fingerprint: bytes) -> None:
        """The message will not be sent."""
        self._write((_DELETE, [(fingerprint,)]))

    def prune(self) -> None:
        """Delete messages that were relayed before the deduplication window."""
        self._write(("DELETE FROM crossed WHERE at < ?", [(time.time() - RELAY_LIMITS.window,)]))

    def relayed(self) -> list[tuple[bytes, float]]:
        """The fingerprints of relayed messages, oldest first, with their age in seconds."""
        now = time.time()
        rows = self._database.rows("SELECT fingerprint, at FROM crossed ORDER BY at")
        return [(fingerprint, now - at) for fingerprint, at in rows]

    def waiting(self) -> list[tuple[Side, RelayMessage]]:
        """The waiting messages with their destination, in their order of arrival."""
        rows = self._database.rows("SELECT * FROM waiting ORDER BY rowid")
        return [(Side(side), RelayMessage(*message)) for *message, side in rows]

    def _open(self) -> None:
        if not try_lock(self._lock):
            raise ConfigurationError(
                f"another bridge uses {self._path}", hint="give this bridge a folder of its own with --data-dir"
            )
        try:
            self._database.open()
            self.prune()
        except BaseException as error:
            self._database.close()
            if isinstance(error, DISK_ERRORS):
                raise self._failed(error) from error
            raise

    def _write(self, *statements: tuple[str, list[tuple[object, ...]]]) -> None:
        try:
            self._database.write(*statements)
        except DISK_ERRORS as error:
            raise self._failed(error) from error

    def _failed(self, error: Exception) -> AiraError:
        hint = "free some disk space; if the file is damaged, stop the bridge and delete it (some messages may then"
        hint += " be relayed twice)"
        return AiraError(f"the journal {self._path} can't be used: {error}", hint=hint, code="journal-failed")


class MessageRelay:
    """Both directions of one bridge.

    `clock` returns seconds; `limit` bounds the queue of each direction; `journal` is kept up to date.
    """

    def __init__(self, clock: Callable[[], float], journal: RelayJournal, *, limit: int = RELAY_LIMITS.waiting) -> None:
        self._clock = clock
        self._journal = journal
        self._limit = limit
        self._seen = SeenMessages(clock)
        self._queues = {side: PublishQueue(limit=limit) for side in Side}
        """What waits to be sent to each side."""
        self._unheard: OrderedDict[bytes, QueuedMessage] = OrderedDict()
        """What was sent to IPFS while nobody listened, to be sent again."""
        self.counts: Final = {side: Counter[str]() for side in Side}
        """Counts of the direction towards each side."""
        self.invalid: Final = {side: Counter[str]() for side in Side}
        self.dropped: Final = {side: Counter[str]() for side in Side}
        self.kinds: Final = {side: Counter[str]() for side in Side}
        self.own: Rank | None = None
        """This bridge's rank; None while it can't send."""
        self.others: Final[set[Rank]] = set()
        """The ranks of the other bridges that can send now."""

    @property
    def is_active(self) -> bool:
        """Whether this bridge sends, rather than stands by."""
        return self.own is not None and not self._stands_by

    @property
    def _stands_by(self) -> bool:
        return bool(self.others) and (self.own is None or min(self.others) < self.own)

    def next(self, side: Side) -> QueuedMessage | None:
        """The next message to send to `side`, which stays in the queue; None while there is none, or on standby."""
        return None if self._stands_by else self._queues[side].next()

    def receive(self, message: RelayMessage, side: Side, *, echo: bool = False, by_bridge: bool = False) -> bool:
        """Take a valid message that was seen on `side`; whether it waits now to be sent to the other one.

        `echo`: this bridge's own daemon reported it, so other nodes may not have it. `by_bridge`: a bridge put it
        there, so it must not be sent back.
        """
        fingerprint, to = message.fingerprint, side.other
        if arrived := self._queues[side].pop(fingerprint) is not None:
            self.counts[side]["left"] += not echo
        if side is Side.IPFS and not echo and self._unheard.pop(fingerprint, None) is not None:
            self._journal.remove_waiting(fingerprint)
        self._record(fingerprint, side, relayed=arrived)
        if by_bridge or fingerprint in self._queues[to] or not self._seen.needs(fingerprint, to):
            self.counts[to]["known"] += 1
            return False
        if not self._queues[to].add(QueuedMessage(message, self._clock())):
            self.dropped[to]["no-room"] += 1
            return False
        self.counts[to]["accepted"] += 1
        self.kinds[to][message.kind] += 1
        self._journal.add_waiting(to, message)
        return True

    def sent(self, queued: QueuedMessage, side: Side, *, heard: bool = True) -> None:
        """This bridge sent the message to `side`. If nobody `heard` it on IPFS, it is kept to be sent again."""
        message = queued.message
        self.counts[side]["carried"] += 1
        self.counts[side]["bytes"] += len(message.legacy if side is Side.IPFS else message.payload)
        waited = self._queues[side].pop(message.fingerprint) is not None
        self._record(message.fingerprint, side, relayed=waited)
        if not heard:
            self._journal.add_waiting(side, message)
            self._unheard[message.fingerprint] = queued
            if len(self._unheard) > self._limit:
                self.dropped[side]["unheard"] += 1
                self._journal.remove_waiting(self._unheard.popitem(last=False)[0])

    def requeue_unheard(self) -> None:
        """There are listeners now: send what nobody heard before all others."""
        for queued in reversed(self._unheard.values()):
            self._queues[Side.IPFS].add(queued, first=True)
        self._unheard.clear()

    def refused(self, queued: QueuedMessage, side: Side) -> None:
        """The destination will never accept the message: drop it."""
        self.dropped[side]["refused"] += 1
        self._drop(queued.message, side)

    def drop_withdrawn(self, order: str, withdrawn: Withdrawals) -> None:
        """A withdrawal of the order with this hash (hexadecimal) arrived: drop what waits and is withdrawn now."""
        for side, queue in self._queues.items():
            held = [*queue, *(self._unheard.values() if side is Side.IPFS else ())]
            for message in [one.message for one in held if one.message.hash == order]:
                if message.order in withdrawn:
                    self.invalid[side]["withdrawn"] += 1
                    self._drop(message, side)

    def restore(self) -> None:
        """Read the journal: the messages already relayed, and those that waited when the bridge stopped."""
        for fingerprint, age in self._journal.relayed():
            for side in Side:
                self._seen.add(fingerprint, side, age=age)
        for side, message in self._journal.waiting():
            self._queues[side].add(QueuedMessage(message, self._clock()))

    def expire(self) -> None:
        """Forget what was left to the active bridge too long ago: its arrival was missed, or its sender repeats it."""
        if not self._stands_by:
            return
        for side, queue in self._queues.items():
            for message in [one.message for one in queue if one.since < self._clock() - RELAY_LIMITS.window]:
                self._drop(message, side)
                self.counts[side]["left"] += 1

    def status(self, to: Side, *, per_second: float) -> DirectionStatus:
        """The counts of the direction towards `to`."""
        counts, waiting = self.counts[to], len(self._queues[to])
        return DirectionStatus(
            **{name: counts[name] for name in ("received", "known", "accepted", "carried", "left", "bytes")},
            invalid=dict(self.invalid[to]),
            dropped=dict(self.dropped[to]),
            waiting=0 if self._stands_by else waiting,
            left_waiting=waiting if self._stands_by else 0,
            unheard=len(self._unheard) if to is Side.IPFS else 0,
            per_second=round(per_second, 2),
            kinds=dict(self.kinds[to]),
        )

    def _record(self, fingerprint: bytes, side: Side, *, relayed: bool) -> None:
        """The message is on `side`; `relayed` if it waited to be sent there."""
        is_new = not self._seen.contains(fingerprint, side)
        self._seen.add(fingerprint, side)
        if relayed:
            self._seen.add_relayed(fingerprint, side)
        if relayed or (is_new and self._seen.contains(fingerprint, side.other)):
            self._journal.mark_relayed(fingerprint)

    def _drop(self, message: RelayMessage, side: Side) -> None:
        self._queues[side].pop(message.fingerprint)
        if side is Side.IPFS:
            self._unheard.pop(message.fingerprint, None)
        self._journal.remove_waiting(message.fingerprint)
