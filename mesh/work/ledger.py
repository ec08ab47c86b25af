"""The ledger: an agent's jobs, its unsent messages, and how far it has read the chain, in one SQLite file.

Every write survives `kill -9` once the call has returned, and a power loss unless it can be repeated: see "What
survives a crash" in docs/architecture.md. Writes are idempotent.
"""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Any, Final, Self

import msgspec
from msgspec.structs import astuple

from mesh.work.database import Database
from mesh.work.phases import UNFINISHED, Phase
from schemas import Liability

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence
    from pathlib import Path

LISTENER: Final = "listener"
"""The name of the only reader of the chain whose cursor the ledger keeps."""
POST: Final = "INSERT OR IGNORE INTO outbox (identity, kind, payload, deadline, posted) VALUES (?, ?, ?, ?, ?)"
NAMES_AT_ONCE: Final = 8192
"""Names in one statement, which may have 32,766 values in SQLite as it is built by default."""
SPENT_KEPT: Final = 4096
"""Most orders that are kept after they became contracts. A reorganisation replaces only the last blocks."""


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


class Outgoing(msgspec.Struct, frozen=True):
    """A signed message that is sent until its effect is seen, or until block `deadline` (None: without end)."""

    identity: str
    kind: str
    payload: bytes
    deadline: int | None


class StoredOrder(msgspec.Struct, frozen=True, kw_only=True):
    """An order of ours that may still become a contract, even if it is withdrawn. `posted` is Unix time."""

    identity: str
    payload: bytes
    posted: float
    is_withdrawn: bool


class WithdrawnOrder(msgspec.Struct, frozen=True, kw_only=True):
    """An order of ours that the transaction `tx` withdrew on the chain."""

    identity: str
    payload: bytes
    tx: str


class Ledger:
    """The ledger in the file at `path`, created if missing: `async with Ledger(path) as ledger`.

    A file belongs to one agent. Calls run in order, in a thread of their own. Every call raises `LedgerUnusable`.
    For contracts that a reorganisation takes back, or brings back, it remembers the last `spent_kept` spent orders, and
    expired orders for `reorg_depth` blocks.
    """

    def __init__(self, path: Path, *, spent_kept: int = SPENT_KEPT, reorg_depth: int = 0) -> None:
        self._database = Database(path)
        self._spent_kept = spent_kept
        self._reorg_depth = reorg_depth

    async def __aenter__(self) -> Self:
        await self._database.open()
        return self

    async def __aexit__(self, *exc_info: object) -> None:
        await self._database.close()

    async def add_job(self, liability: Liability) -> bool:
        """Add a job as INCOMING, or bring back one that was set aside. False if it was known already."""
        return await self._database.run(
            "INSERT INTO jobs (liability, phase, record, changed) VALUES (?, ?, ?, ?)"
            " ON CONFLICT (liability) DO UPDATE SET aside = 0 WHERE aside",
            (liability.address, Phase.INCOMING, liability.encode(), time.time()),
            sync=False,
        )

    async def set_aside(self, liability: str) -> None:
        """Hide a job, with everything that is known of it, until `add_job` or `bring_back` shows it again."""
        await self._database.run("UPDATE jobs SET aside = 1 WHERE liability = ?", (liability,), sync=False)

    async def bring_back(self, liability: str) -> bool:
        """Show a job that was set aside. False if there is none."""
        statement = "UPDATE jobs SET aside = 0 WHERE liability = ? AND aside"
        return await self._database.run(statement, (liability,), sync=False)

    async def set_phase(self, liability: str, phase: Phase, *, position: int | None = None) -> None:
        """Set the phase of the job at `liability` (address) and, if given, how many messages it has played."""
        await self._database.run(
            "UPDATE jobs SET phase = ?, position = COALESCE(?, position), changed = ? WHERE liability = ?",
            (phase, position, time.time(), liability),
            sync=False,
        )

    async def set_position(self, liability: str, position: int, *, recorded: int) -> None:
        """Set how many messages the job at `liability` (address) has played.

        Its recording must already have `recorded` messages on the disk, and with them all that were played.
        """
        await self._database.run(
            "UPDATE jobs SET position = ?, recorded = ? WHERE liability = ?", (position, recorded, liability)
        )

    async def complete(self, liability: str, *, success: bool, result: str, note: str, outgoing: Outgoing) -> None:
        """Set the job's outcome and keep its signed Result for sending: both or neither."""
        ended = "UPDATE jobs SET phase = ?, success = ?, result = ?, note = ?, changed = ? WHERE liability = ?"
        await self._database.run_together(
            (ended, (Phase.COMPLETE, success, result, note, time.time(), liability)), (POST, _posted(outgoing))
        )

    async def job(self, liability: str) -> JobRecord | None:
        """The job at `liability` (EIP-55 address), if there is one."""
        rows = await self._database.rows("SELECT * FROM jobs WHERE liability = ? AND NOT aside", (liability,))
        return _job(rows[0]) if rows else None

    async def jobs(self, phases: Iterable[Phase] = UNFINISHED) -> list[JobRecord]:
        """The jobs in the given phases, oldest first."""
        wanted = tuple(phases)
        marks = ",".join("?" * len(wanted))
        statement = f"SELECT * FROM jobs WHERE phase IN ({marks}) AND NOT aside ORDER BY rowid"
        return [_job(row) for row in await self._database.rows(statement, wanted)]

    async def promisees(self, limit: int) -> list[str]:
        """The promisees of the latest jobs, of `limit` jobs at most, the latest last."""
        rows = await self._database.rows("SELECT record FROM jobs ORDER BY rowid DESC LIMIT ?", (limit,))
        return [Liability.decode(row[0]).promisee for row in reversed(rows)]

    async def holds(self, names: Sequence[str]) -> set[str]:
        """Those of some names that are a job's liability (address), or the identity of a message in the outbox."""
        held: set[str] = set()
        for start in range(0, len(names), NAMES_AT_ONCE):
            some = names[start : start + NAMES_AT_ONCE]
            marks = ",".join("?" * len(some))
            statement = f"SELECT liability FROM jobs WHERE liability IN ({marks})"
            statement += f" UNION SELECT identity FROM outbox WHERE identity IN ({marks})"
            held |= {row[0] for row in await self._database.rows(statement, (*some, *some))}
        return held

    async def jobs_by_phase(self) -> dict[str, int]:
        """The number of jobs in each phase that has any."""
        return {phase: count for phase, count, _ in await self.phases()}

    async def phases(self) -> list[tuple[str, int, float]]:
        """Each phase that has jobs: how many, and when (Unix time) the first of them entered it."""
        statement = "SELECT phase, COUNT(*), MIN(changed) FROM jobs WHERE NOT aside GROUP BY phase"
        return await self._database.rows(statement)

    async def post(self, outgoing: Outgoing) -> None:
        """Keep a signed message for sending, until `settle`."""
        await self._database.run(POST, _posted(outgoing))

    async def settle(self, identity: str) -> bool:
        """Remove a message whose effect was seen. False if it was not in the outbox."""
        return await self._database.run("DELETE FROM outbox WHERE identity = ?", (identity,), sync=False)

    async def spend(self, identity: str, liability: str) -> None:
        """Take an order out of the outbox that became the contract at `liability`, and keep it for `unspend`."""
        keep = "INSERT OR REPLACE INTO spent SELECT identity, kind, payload, deadline, posted, ? FROM"
        await self._database.run_together(
            (f"{keep} outbox WHERE identity = ?", (liability, identity)),
            (f"{keep} withdrawn WHERE identity = ?", (liability, identity)),
            ("DELETE FROM outbox WHERE identity = ?", (identity,)),
            ("UPDATE withdrawn SET used_by = ? WHERE identity = ?", (liability, identity)),
            ("DELETE FROM spent WHERE rowid <= (SELECT MAX(rowid) FROM spent) - ?", (self._spent_kept,)),
            sync=False,
        )

    async def spent(self, liability: str) -> list[Outgoing]:
        """The orders that became the contract at this address, withdrawn ones included."""
        statement = "SELECT identity, kind, payload, deadline FROM spent WHERE liability = ?"
        return [Outgoing(*row) for row in await self._database.rows(statement, (liability,))]

    async def contracts(self, kind: str) -> list[tuple[bytes, str]]:
        """The 64 latest orders of a kind, also withdrawn, that became contracts: payload, contract's address."""
        statement = "SELECT payload, liability FROM spent WHERE kind = ? ORDER BY posted DESC LIMIT 64"
        return await self._database.rows(statement, (kind,))

    async def unspend(self, liability: str) -> None:
        """Move the orders of a reverted contract back into the outbox. Withdrawn ones stay withdrawn."""
        columns = "identity, kind, payload, deadline, posted"
        back = f"INSERT OR IGNORE INTO outbox ({columns}) SELECT {columns} FROM spent WHERE liability = ?"
        await self._database.run_together(
            (f"{back} AND identity NOT IN (SELECT identity FROM withdrawn)", (liability,)),
            ("DELETE FROM spent WHERE liability = ?", (liability,)),
            ("UPDATE withdrawn SET used_by = '' WHERE used_by = ?", (liability,)),
            sync=False,
        )

    async def withdraw(self, identity: str, withdrawal: Outgoing) -> None:
        """Replace an order by its signed withdrawal, and remember the order while it may become a contract."""
        await self._database.run_together(
            ("INSERT OR IGNORE INTO withdrawn SELECT *, '' FROM outbox WHERE identity = ?", (identity,)),
            ("DELETE FROM outbox WHERE identity = ?", (identity,)),
            (POST, _posted(withdrawal)),
        )

    async def use_up(self, identity: str, tx: str) -> None:
        """The transaction `tx` has made sure that a withdrawn order can't become a contract any more."""
        await self._database.run("UPDATE withdrawn SET used_by = ? WHERE identity = ?", (tx, identity))

    async def withdrawn_on_chain(self, *, head: int) -> list[WithdrawnOrder]:
        """The orders that transactions of ours withdrew, with a deadline after block `head`, the oldest first."""
        rows = await self._database.rows(
            "SELECT identity, payload, used_by FROM withdrawn"
            " WHERE LENGTH(used_by) = 66 AND deadline > ? ORDER BY posted",  # an address is shorter
            (head,),
        )
        return [WithdrawnOrder(identity=row[0], payload=row[1], tx=row[2]) for row in rows]

    async def replace(self, identity: str, outgoing: Outgoing) -> None:
        """Keep a message for sending instead of the one called `identity`."""
        remove = ("DELETE FROM outbox WHERE identity = ?", (identity,))
        await self._database.run_together(remove, (POST, _posted(outgoing)))

    async def orders(self) -> list[StoredOrder]:
        """The orders that may still become contracts, oldest first: those in the outbox, then the withdrawn ones.

        Check their deadlines: expired ones are among them.
        """
        rows = await self._database.rows(
            "SELECT identity, payload, posted, 0 FROM outbox WHERE kind IN ('demand', 'offer')"
            " UNION ALL SELECT identity, payload, posted, 1 FROM withdrawn WHERE used_by = '' ORDER BY 4, 3"
        )
        return [StoredOrder(identity=row[0], payload=row[1], posted=row[2], is_withdrawn=bool(row[3])) for row in rows]

    async def outbox(self, *, head: int) -> list[Outgoing]:
        """The messages to send, oldest first: not those whose deadline block `head` has reached.

        Deletes the latter `reorg_depth` blocks after their deadline.
        """
        last = head - self._reorg_depth
        rows = await self._database.rows(
            "SELECT identity, kind, payload, deadline, rowid FROM outbox"
            " UNION ALL SELECT identity, kind, payload, deadline, 0 FROM withdrawn WHERE deadline <= ? ORDER BY rowid",
            (last,),
        )
        if any(row[3] is not None and row[3] <= last for row in rows):
            await self._database.run_together(
                *((f"DELETE FROM {table} WHERE deadline <= ?", (last,)) for table in ("outbox", "withdrawn")),
                sync=False,
            )
        return [Outgoing(*row[:4]) for row in rows if row[3] is None or row[3] > head]

    async def waiting_by_kind(self, *, head: int) -> dict[str, int]:
        """The messages to send of each kind (`demand`, `offer`, `withdrawal`, `result`) that has any."""
        statement = "SELECT kind, COUNT(*) FROM outbox WHERE deadline IS NULL OR deadline > ? GROUP BY kind"
        return dict(await self._database.rows(statement, (head,)))

    async def cursor(self) -> tuple[int | None, bytes]:
        """The last block that the listener has handled (None: it never handled one), and its encoded chain history."""
        rows = await self._database.rows("SELECT block, history FROM cursors WHERE name = ?", (LISTENER,))
        return rows[0] if rows else (None, b"")

    async def set_cursor(self, block: int, *, history: bytes = b"") -> None:
        """Save that the listener has handled all of `block`, with its encoded chain history."""
        statement = "INSERT OR REPLACE INTO cursors (name, block, history) VALUES (?, ?, ?)"
        await self._database.run(statement, (LISTENER, block, history), sync=False)


def _job(row: Any) -> JobRecord:
    return JobRecord(
        liability=Liability.decode(row[2]),
        phase=Phase(row[1]),
        success=None if row[3] is None else bool(row[3]),
        result=row[4],
        position=row[5],
        recorded=row[9],
        note=row[6],
    )


def _posted(outgoing: Outgoing) -> tuple[Any, ...]:
    return (*astuple(outgoing), time.time())
