"""The ledger: an agent's jobs and their phases, its unsent messages and its orders, in one SQLite file. And the outbox,
which sends these messages again, with backoff, until their effect is seen on the chain.

Every write survives `kill -9` once the call has returned, and a power loss unless it can be repeated: see "What
survives a crash" in docs/explanation/decisions/jobs.md. Writes are idempotent.
"""

from __future__ import annotations

import asyncio
import logging
import random
import time
from contextlib import suppress
from dataclasses import dataclass
from enum import StrEnum
from functools import partial
from typing import TYPE_CHECKING, Any, Final, TypeAlias, TypeVar

import msgspec
from msgspec.json import encode as json_encode
from msgspec.structs import astuple

from mesh.base.database import RoleLedger
from mesh.base.flood import Rate, RateLimiter
from mesh.base.log_context import log_event
from mesh.base.retry import Backoff
from mesh.errors import AiraError
from schemas import Demand, Liability, Offer, Permit, Result, Withdrawal, decode, encode, message_hash
from schemas.records import ControlRobot

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Iterable, Iterator, Mapping, Sequence
    from pathlib import Path

    from mesh.base.retry import RetryPolicy
    from mesh.network import Channel, Network

log = logging.getLogger(__name__)

Resent: TypeAlias = Demand | Offer | Withdrawal | Result
"""The messages that are sent again until their effect is on the chain."""


class Phase(StrEnum):
    """Where a job is. The ledger keeps it, and a restarted agent continues from it."""

    INCOMING = "incoming"
    """The liability exists and names this agent; its objective has not been fetched yet."""
    READY = "ready"
    """The objective was fetched and can be played; the job waits for `start`."""
    RUNNING = "running"
    """The objective is being played and the device recorded."""
    COMPLETE = "complete"
    """The recording is closed and the Result signed; it is sent until the contract has it."""
    FINALIZED = "finalized"
    """The contract has paid or refunded. Nothing is left to do."""


NEXT: Final = {
    Phase.INCOMING: frozenset({Phase.READY, Phase.COMPLETE, Phase.FINALIZED}),
    Phase.READY: frozenset({Phase.RUNNING, Phase.COMPLETE, Phase.FINALIZED}),
    Phase.RUNNING: frozenset({Phase.COMPLETE, Phase.FINALIZED}),
    Phase.COMPLETE: frozenset({Phase.FINALIZED}),
    Phase.FINALIZED: frozenset(),
}
"""The phases that may follow each phase. A job that fails moves to COMPLETE without success, which refunds."""

UNFINISHED: Final = (Phase.INCOMING, Phase.READY, Phase.RUNNING, Phase.COMPLETE)

TO_BE_DONE: Final = (Phase.INCOMING, Phase.READY, Phase.RUNNING)
"""Phases of a job whose work is not done yet."""

STARTABLE: Final = (Phase.READY, Phase.RUNNING)
"""Phases in which a job's playback may begin, continue or be restarted."""


class WrongPhase(AiraError, code="wrong-phase"):
    """The job's phase does not allow the operation. `phase` is its phase, None if the agent has no such job."""

    def __init__(self, liability: str, *, asked: str, phase: Phase | None) -> None:
        where = f"is {phase.value}" if phase else "is not a job of this agent"
        super().__init__(f"can't {asked} {liability}: it {where}")
        self.liability = liability
        self.asked = asked
        self.phase = phase


def advance(liability: str, phase: Phase, to: Phase) -> Phase:
    """`to`, if a job may move there from `phase`. Raises `WrongPhase` otherwise."""
    if to not in NEXT[phase]:
        raise WrongPhase(liability, asked=f"move to {to.value}", phase=phase)
    return to


SCHEMA: Final = """
CREATE TABLE IF NOT EXISTS jobs (
    liability TEXT PRIMARY KEY,
    phase TEXT NOT NULL,
    record BLOB NOT NULL,
    success INTEGER,
    result TEXT,
    position INTEGER NOT NULL DEFAULT 0,
    recorded INTEGER NOT NULL DEFAULT 0,
    note TEXT NOT NULL DEFAULT '',
    aside INTEGER NOT NULL DEFAULT 0,
    changed REAL NOT NULL
);
CREATE TABLE IF NOT EXISTS stops (
    liability TEXT PRIMARY KEY,
    why TEXT NOT NULL,
    code TEXT NOT NULL
);
CREATE TABLE IF NOT EXISTS control (
    one INTEGER PRIMARY KEY CHECK (one = 1),
    record BLOB NOT NULL
);
CREATE INDEX IF NOT EXISTS jobs_by_phase ON jobs (phase, changed) WHERE NOT aside;
CREATE TABLE IF NOT EXISTS outbox (
    identity TEXT PRIMARY KEY,
    kind TEXT NOT NULL,
    payload BLOB NOT NULL,
    deadline INTEGER,
    robot TEXT NOT NULL,
    posted REAL NOT NULL,
    withdrawn INTEGER NOT NULL DEFAULT 0,
    tx TEXT NOT NULL DEFAULT ''
);
CREATE TABLE IF NOT EXISTS spent (
    identity TEXT PRIMARY KEY,
    kind TEXT NOT NULL,
    payload BLOB NOT NULL,
    deadline INTEGER,
    robot TEXT NOT NULL,
    posted REAL NOT NULL,
    withdrawn INTEGER NOT NULL,
    liability TEXT NOT NULL
);
"""
"""A withdrawn order is not sent, but may become a contract all the same, unless the transaction `tx` prevents that. The
orders that became contracts are in `spent`; `robot` is empty in those that are for any."""
OUTGOING: Final = "identity, kind, payload, deadline, robot"
COLUMNS: Final = f"{OUTGOING}, posted, withdrawn"
POST: Final = f"INSERT OR IGNORE INTO outbox ({OUTGOING}, posted) VALUES (?, ?, ?, ?, ?, ?)"


class JobRecord(msgspec.Struct, frozen=True, kw_only=True):
    """A job as the ledger holds it.

    `success` and `result` (CIDv0 of the recording) are set from COMPLETE on. `position` counts the objective's messages
    that were played; its recording had `recorded` messages on the disk then. `note` says why a job failed.
    """

    liability: Liability
    phase: Phase
    success: bool | None
    result: str | None
    position: int
    recorded: int
    note: str


class Stop(msgspec.Struct, frozen=True):
    """A job was stopped: `why`, for people, and the `code` that it ends with."""

    why: str
    code: str


class Outgoing(msgspec.Struct, frozen=True):
    """A signed message that is sent until its effect is seen, or until block `deadline` (None: without end).

    An order with a `robot` (address) is for that one alone, and never published.
    """

    identity: str
    kind: str
    payload: bytes
    deadline: int | None
    robot: str = ""

    @classmethod
    def of(cls, message: Resent, *, robot: str = "") -> Outgoing:
        """The entry for a signed message; with a `robot` for an order that is for that one alone."""
        deadline = None if isinstance(message, Result) else message.deadline
        return cls(outgoing_identity(message), type(message).__name__.lower(), encode(message), deadline, robot)


def outgoing_identity(message: Resent) -> str:
    """The key of a message in the outbox: an order's hash, a Withdrawal's order, a Result's liability."""
    if isinstance(message, Result):
        return result_identity(message.liability)
    if isinstance(message, Withdrawal):
        return f"withdrawal {message.order}"
    return message_hash(message).hex()


def result_identity(liability: str) -> str:
    """The key of the Result of the liability at that address, of which there is only one."""
    return f"result {liability}"


class StoredOrder(msgspec.Struct, frozen=True):
    """An order of ours that is no contract. `posted` is Unix time; `tx` is the transaction that withdrew it, if any."""

    identity: str
    payload: bytes
    posted: float
    is_withdrawn: bool
    tx: str
    robot: str
    """The only robot that it is for; empty for any."""


class Ledger(RoleLedger):
    """The ledger in the file at `path`, created if missing: `async with Ledger(path) as ledger`.

    For contracts that a reorganisation takes back, or brings back, it remembers the last `spent_kept` spent orders, and
    expired orders for `reorg_depth` blocks.
    """

    schema = SCHEMA

    def __init__(self, path: Path, *, spent_kept: int = 4096, reorg_depth: int = 0) -> None:
        super().__init__(path)
        self._spent_kept = spent_kept
        self._reorg_depth = reorg_depth

    async def add_job(self, liability: Liability) -> bool:
        """Add a job as INCOMING, or bring back one that was set aside. False if it was known already."""
        return await self._run(
            "INSERT INTO jobs (liability, phase, record, changed) VALUES (?, ?, ?, ?)"
            " ON CONFLICT (liability) DO UPDATE SET aside = 0 WHERE aside",
            (liability.address, Phase.INCOMING, liability.encode(), time.time()),
            sync=False,
        )

    async def set_aside(self, liability: str) -> None:
        """Hide a job, with everything that is known of it, until `add_job` or `bring_back` shows it again."""
        await self._run("UPDATE jobs SET aside = 1 WHERE liability = ?", (liability,), sync=False)

    async def bring_back(self, liability: str) -> bool:
        """Show a job that was set aside. False if there is none."""
        statement = "UPDATE jobs SET aside = 0 WHERE liability = ? AND aside"
        return await self._run(statement, (liability,), sync=False)

    async def set_phase(self, liability: str, phase: Phase, *, position: int | None = None) -> None:
        """Set the phase of the job at `liability` (address) and, if given, how many messages it has played."""
        await self._run(
            "UPDATE jobs SET phase = ?, position = COALESCE(?, position), changed = ? WHERE liability = ?",
            (phase, position, time.time(), liability),
            sync=False,
        )

    async def set_position(self, liability: str, position: int, *, recorded: int) -> None:
        """Set how many messages the job at `liability` (address) has played.

        Its recording must already have `recorded` messages on the disk, and with them all that were played.
        """
        await self._run(
            "UPDATE jobs SET position = ?, recorded = ? WHERE liability = ?", (position, recorded, liability)
        )

    async def complete(self, liability: str, *, success: bool, result: str, note: str, outgoing: Outgoing) -> None:
        """Set the job's outcome and keep its signed Result for sending: both or neither."""
        ended = "UPDATE jobs SET phase = ?, success = ?, result = ?, note = ?, changed = ? WHERE liability = ?"
        await self._run_together(
            (ended, (Phase.COMPLETE, success, result, note, time.time(), liability)), (POST, _posted(outgoing))
        )

    async def stop(self, liability: str, stop: Stop) -> None:
        """Keep that the job at `liability` (address) was stopped. The first stop counts."""
        await self._run("INSERT OR IGNORE INTO stops VALUES (?, ?, ?)", (liability, stop.why, stop.code))

    async def stopped(self, liability: str) -> Stop | None:
        """How the job at `liability` (address) was stopped; None if it was not."""
        rows = await self._rows("SELECT why, code FROM stops WHERE liability = ?", (liability,))
        return Stop(*rows[0]) if rows else None

    async def keep_control(self, changed: ControlRobot) -> None:
        """Keep what the owner has changed while the agent ran."""
        await self._run("INSERT OR REPLACE INTO control VALUES (1, ?)", (changed.encode(),))

    async def control(self) -> ControlRobot:
        """What the owner has changed, also in earlier runs."""
        rows = await self._rows("SELECT record FROM control")
        return ControlRobot.decode(rows[0][0]) if rows else ControlRobot()

    async def job(self, liability: str) -> JobRecord | None:
        """The job at `liability` (EIP-55 address), if there is one."""
        rows = await self._rows("SELECT * FROM jobs WHERE liability = ? AND NOT aside", (liability,))
        return _job(rows[0]) if rows else None

    async def jobs(self, phases: Iterable[Phase] = UNFINISHED) -> list[JobRecord]:
        """The jobs in the given phases, oldest first."""
        wanted = (json_encode(tuple(phases)),)
        statement = "SELECT * FROM jobs WHERE phase IN (SELECT value FROM json_each(?)) AND NOT aside ORDER BY rowid"
        return [_job(row) for row in await self._rows(statement, wanted)]

    async def promisees(self, limit: int) -> list[str]:
        """The promisees of the latest jobs, of `limit` jobs at most, the latest last."""
        rows = await self._rows("SELECT record FROM jobs ORDER BY rowid DESC LIMIT ?", (limit,))
        return [Liability.decode(row[0]).promisee for row in reversed(rows)]

    async def holds(self, names: Sequence[str]) -> set[str]:
        """Those of some names that are a job's liability (address), or the identity of a message in the outbox."""
        statement = (
            "WITH names AS (SELECT value FROM json_each(?)) SELECT liability FROM jobs WHERE liability IN names"
            " UNION SELECT identity FROM outbox WHERE identity IN names"
        )
        return {row[0] for row in await self._rows(statement, (json_encode(names),))}

    async def jobs_by_phase(self) -> dict[str, int]:
        """The number of jobs in each phase that has any."""
        return {phase: count for phase, count, _ in await self.phases()}

    async def phases(self) -> list[tuple[str, int, float]]:
        """Each phase that has jobs: how many, and when (Unix time) the first of them entered it."""
        statement = "SELECT phase, COUNT(*), MIN(changed) FROM jobs WHERE NOT aside GROUP BY phase"
        return await self._rows(statement)

    async def post(self, outgoing: Outgoing) -> None:
        """Keep a signed message for sending, until `settle`."""
        await self._run(POST, _posted(outgoing))

    async def settle(self, identity: str) -> bool:
        """Remove a message whose effect was seen. False if it was not in the outbox."""
        statement = "DELETE FROM outbox WHERE identity = ? AND NOT withdrawn"
        return await self._run(statement, (identity,), sync=False)

    async def spend(self, identity: str, liability: str) -> None:
        """Take an order out of the outbox that became the contract at `liability`, and keep it for `unspend`."""
        keep = f"INSERT OR REPLACE INTO spent SELECT {COLUMNS}, ? FROM outbox WHERE identity = ?"
        await self._run_together(
            (keep, (liability, identity)),
            ("DELETE FROM outbox WHERE identity = ?", (identity,)),
            ("DELETE FROM spent WHERE rowid <= (SELECT MAX(rowid) FROM spent) - ?", (self._spent_kept,)),
            sync=False,
        )

    async def spent(self, liability: str) -> list[Outgoing]:
        """The orders that became the contract at this address, withdrawn ones included."""
        rows = await self._rows(f"SELECT {OUTGOING} FROM spent WHERE liability = ?", (liability,))
        return [Outgoing(*row) for row in rows]

    async def contracts(self, kind: str) -> list[tuple[bytes, str]]:
        """The 64 latest orders of a kind, also withdrawn, that became contracts: payload, contract's address."""
        statement = "SELECT payload, liability FROM spent WHERE kind = ? ORDER BY posted DESC LIMIT 64"
        return await self._rows(statement, (kind,))

    async def unspend(self, liability: str) -> None:
        """Move the orders of a reverted contract back into the outbox. Withdrawn ones stay withdrawn."""
        back = f"INSERT OR IGNORE INTO outbox ({COLUMNS}) SELECT {COLUMNS} FROM spent WHERE liability = ?"
        remove = "DELETE FROM spent WHERE liability = ?"
        await self._run_together((back, (liability,)), (remove, (liability,)), sync=False)

    async def withdraw(self, withdrawals: Mapping[str, Outgoing]) -> None:
        """Send their signed withdrawals instead of orders, which are remembered while they may become contracts."""
        await self._run_together(
            *(
                step
                for identity, withdrawal in withdrawals.items()
                for step in (
                    ("UPDATE outbox SET withdrawn = 1 WHERE identity = ?", (identity,)),
                    (POST, _posted(withdrawal)),
                )
            )
        )

    async def use_up(self, identity: str, tx: str) -> None:
        """The transaction `tx` has made sure that a withdrawn order can't become a contract any more."""
        await self._run("UPDATE outbox SET tx = ? WHERE identity = ?", (tx, identity))

    async def withdrawn_on_chain(self, *, head: int) -> list[StoredOrder]:
        """The orders that transactions of ours withdrew, with a deadline after block `head`, the oldest first."""
        return await self._stored("tx != '' AND deadline > ? ORDER BY posted", (head,))

    async def replace(self, identity: str, outgoing: Outgoing) -> None:
        """Keep a message for sending instead of the one called `identity`."""
        remove = ("DELETE FROM outbox WHERE identity = ?", (identity,))
        await self._run_together(remove, (POST, _posted(outgoing)))

    async def orders(self) -> list[StoredOrder]:
        """The orders that may still become contracts, oldest first, the withdrawn ones behind the others.

        Check their deadlines: expired ones are among them.
        """
        return await self._stored("kind IN ('demand', 'offer') AND tx = '' ORDER BY withdrawn, posted")

    async def _stored(self, condition: str, values: tuple[Any, ...] = ()) -> list[StoredOrder]:
        statement = f"SELECT identity, payload, posted, withdrawn, tx, robot FROM outbox WHERE {condition}"
        rows = await self._rows(statement, values)
        return [
            StoredOrder(identity, payload, posted, bool(withdrawn), tx, robot)
            for identity, payload, posted, withdrawn, tx, robot in rows
        ]

    async def outbox(self, *, head: int) -> list[Outgoing]:
        """The messages to send, oldest first: not those whose deadline block `head` has reached.

        Deletes the latter `reorg_depth` blocks after their deadline.
        """
        last = head - self._reorg_depth
        rows = await self._rows(
            f"SELECT {OUTGOING}, withdrawn FROM outbox WHERE NOT withdrawn OR deadline <= ? ORDER BY rowid", (last,)
        )
        if any(row[3] is not None and row[3] <= last for row in rows):
            await self._run("DELETE FROM outbox WHERE deadline <= ?", (last,), sync=False)
        return [Outgoing(*row[:5]) for row in rows if not row[5] and (row[3] is None or row[3] > head)]

    async def waiting_by_kind(self, *, head: int) -> dict[str, int]:
        """The messages to send of each kind (`demand`, `offer`, `withdrawal`, `result`) that has any."""
        condition = "NOT withdrawn AND (deadline IS NULL OR deadline > ?)"
        statement = f"SELECT kind, COUNT(*) FROM outbox WHERE {condition} GROUP BY kind"
        return dict(await self._rows(statement, (head,)))


def _job(row: Any) -> JobRecord:
    return JobRecord(
        liability=Liability.decode(row[2]),
        phase=Phase(row[1]),
        success=None if row[3] is None else bool(row[3]),
        result=row[4],
        position=row[5],
        recorded=row[6],
        note=row[7],
    )


def _posted(outgoing: Outgoing) -> tuple[Any, ...]:
    return (*astuple(outgoing), time.time())


T = TypeVar("T")

RESEND_RATE: Final = Rate(per_second=50.0, burst=250)
"""Messages that are sent again, in all: strangers can make a robot offer, and tell it that a provider appeared."""


@dataclass
class _Attempts:
    """A message, and when it is sent next (in seconds of the clock; 0: at once)."""

    message: Resent
    backoff: Backoff
    robot: str = ""
    next_at: float = 0.0

    def is_open(self, head: int) -> bool:
        """Whether block `head` has not reached the deadline of its order."""
        return isinstance(self.message, Result) or self.message.deadline > head


class Outbox:
    """Sends the messages that the ledger holds to the channel. Receivers drop duplicates.

    A message is sent when it is posted, and then again after growing delays (`policy`). All are sent at once, and their
    delays start over, when `run` starts, when the network returns and when a provider or a validator appears on the
    market: it starts with an empty order book, or has missed a Result. Beyond `RESEND_RATE` messages wait: the oldest
    longest, and offers behind all others. `clock` (seconds) and `chance` (0 to 1, for jitter) are injected by tests.

    An order that is for one robot alone is not put on the channel: `send_alone` is called with a demand and its robot,
    and an offer stays here.
    """

    def __init__(
        self,
        ledger: Ledger,
        channel: Channel,
        network: Network,
        *,
        head: Callable[[], int],
        policy: RetryPolicy,
        clock: Callable[[], float] = time.monotonic,
        chance: Callable[[], float] = random.random,
    ) -> None:
        self._ledger = ledger
        self._channel = channel
        self._network = network
        self._head = head
        self._policy = policy
        self._clock = clock
        self._chance = chance
        self._attempts: dict[str, _Attempts] = {}
        """What the ledger held when it was read, without what was settled since; the oldest first."""
        self._lock = asyncio.Lock()
        """Held while the ledger is read, or loses a message: what is settled must not come back."""
        self._held: set[str] = set()
        self._fresh: set[str] = set()
        """Messages that were never sent, in this run or an earlier one."""
        self._limiter = RateLimiter(per_sender=RESEND_RATE)
        self.send_alone: Callable[[Demand, str], object] = lambda _demand, _robot: None
        self.permit_for: Callable[[Demand], Permit | None] = lambda _demand: None
        """Returns the permit that travels before a demand."""
        self._changed = asyncio.Event()

    async def post(self, message: Resent, *, robot: str = "") -> None:
        """Keep a signed message until `settle`, and send it now; with a `robot`, an order for that one alone."""
        self._fresh.add(outgoing_identity(message))
        await self._ledger.post(Outgoing.of(message, robot=robot))
        await self.send_new()

    async def settle(self, identity: str) -> bool:
        """Stop sending a message: its effect was seen. False if it was not in the outbox."""
        return await self._without(identity, partial(self._ledger.settle, identity))

    async def spend(self, identity: str, liability: str) -> None:
        """Stop sending an order: it became the contract at the address `liability`, unless that is reverted."""
        await self._without(identity, partial(self._ledger.spend, identity, liability))

    async def unspend(self, liability: str) -> list[Outgoing]:
        """Take back the orders of a reverted contract; they are sent again after `release`. Returns them."""
        orders = await self._ledger.spent(liability)
        self.hold(order.identity for order in orders)
        await self._ledger.unspend(liability)
        return orders

    async def withdraw(self, *withdrawals: Withdrawal) -> None:
        """Stop sending orders, and send their signed withdrawals until the orders' deadlines."""
        self._fresh.update(map(outgoing_identity, withdrawals))
        async with self._lock:
            for withdrawal in withdrawals:
                self._attempts.pop(withdrawal.order, None)
            await self._ledger.withdraw({withdrawal.order: Outgoing.of(withdrawal) for withdrawal in withdrawals})
        await self.send_new()

    async def replace(self, identity: str, message: Resent, *, robot: str = "") -> None:
        """Send a signed message instead of the one called `identity`."""
        await self._without(identity, partial(self._ledger.replace, identity, Outgoing.of(message, robot=robot)))
        await self.send_new()

    def hold(self, identities: Iterable[str]) -> None:
        """Don't send these messages before `release`."""
        self._held.update(identities)

    async def release(self, identities: Iterable[str]) -> None:
        self._held.difference_update(identities)
        await self.send_new()

    async def send_new(self) -> None:
        """Send the messages of the ledger that were not sent yet, and those whose time has come."""
        async with self._lock:
            known, unsent = self._attempts, await self._ledger.outbox(head=self._head())
            self._attempts = {one.identity: known.get(one.identity) or self._first_attempt(one) for one in unsent}
        self.send_due()

    async def send_all(self) -> None:
        """Send all messages, and start their delays over."""
        self._attempts.clear()
        await self.send_new()

    def send_due(self) -> None:
        """Send the messages whose time has come."""
        now = self._clock()
        due = [(identity, one) for identity, one in self._sendable() if one.next_at <= now]
        offers = [(identity, one) for identity, one in due if isinstance(one.message, Offer)]
        others = [(identity, one) for identity, one in due if not isinstance(one.message, Offer)]
        for identity, one in (*others, *reversed(offers)):
            wait = 0.5  # it exceeded the rate
            if identity in self._fresh or self._limiter.allow(""):
                self._fresh.discard(identity)
                if not one.robot:
                    if isinstance(one.message, Demand) and (permit := self.permit_for(one.message)) is not None:
                        self._channel.publish(permit)
                    self._channel.publish(one.message)
                elif isinstance(one.message, Demand):
                    self.send_alone(one.message, one.robot)
                wait = one.backoff.next_delay() or 0.0
            one.next_at = now + wait
        self._changed.set()

    async def expire(self, head: int) -> None:
        """Drop the orders whose deadline block `head` has reached."""
        if not all(one.is_open(head) for one in self._attempts.values()):
            async with self._lock:
                await self._ledger.outbox(head=head)
                self._attempts = {identity: one for identity, one in self._attempts.items() if one.is_open(head)}

    async def run(self) -> None:
        """Send messages when they are due, until cancelled."""
        appeared = asyncio.Event()
        for role in ("provider", "validator"):
            self._channel.watch_presence(lambda _key: appeared.set(), role=role)
        async with asyncio.TaskGroup() as tasks:
            tasks.create_task(self._send_on_return(), name="outbox after network loss")
            tasks.create_task(self._send_to_newcomers(appeared), name="outbox to newcomers")
            await self.send_all()
            while True:
                await self._wait()
                self.send_due()

    def _sendable(self) -> Iterator[tuple[str, _Attempts]]:
        """The messages that are neither held nor expired, the oldest first."""
        head = self._head()
        return (
            (key, one)
            for key, one in self._attempts.items()
            if key not in self._held and one.is_open(head) and not (one.robot and isinstance(one.message, Offer))
        )

    async def _without(self, identity: str, remove: Callable[[], Awaitable[T]]) -> T:
        """Call what removes a message from the ledger."""
        async with self._lock:
            self._attempts.pop(identity, None)
            return await remove()

    def _first_attempt(self, one: Outgoing) -> _Attempts:
        message = decode(one.payload)
        assert isinstance(message, Resent)
        return _Attempts(message, Backoff(self._policy, chance=self._chance), one.robot)

    async def _wait(self) -> None:
        """Wait until the next attempt is due."""
        while True:
            self._changed.clear()
            first = min((one.next_at for _, one in self._sendable()), default=None)
            remaining = None if first is None else first - self._clock()
            if remaining is not None and remaining <= 0:
                return
            with suppress(TimeoutError):
                async with asyncio.timeout(remaining):
                    await self._changed.wait()

    async def _send_on_return(self) -> None:
        async for _ in self._network.changes():
            if self._network.connected:
                await self.send_all()

    async def _send_to_newcomers(self, appeared: asyncio.Event) -> None:
        while True:
            await appeared.wait()
            appeared.clear()
            log.debug(
                "a provider or validator appeared: all unsent messages are sent again",
                extra=log_event("provider-appeared"),
            )
            await self.send_all()
