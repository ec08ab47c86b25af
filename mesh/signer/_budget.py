"""What a signer must not forget: orders by their keys, what they cost, consents, and the head of the log.

One SQLite file. What an order may cost is in it, and on the disk, before anything is signed. An order counts until it
is known that it became no contract; what it cost then counts for the hour and the day of its contract, also if that is
refunded. Time only moves forward here: a clock that is set back frees nothing.
"""

from __future__ import annotations

import time
from enum import StrEnum
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import msgspec

from mesh.base.database import SyncedDatabase
from mesh.errors import ConfigurationError
from mesh.signer.policy import DAY, HOUR, Spending
from mesh.signer.protocol import OVER, JobState, OnStop, OrderJob, SignerFailure
from schemas.decoding import decode_json

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

SCHEMA: Final = """
CREATE TABLE IF NOT EXISTS jobs (
    id TEXT PRIMARY KEY,
    key TEXT NOT NULL UNIQUE,
    digest TEXT NOT NULL,
    cost TEXT NOT NULL,
    hold TEXT NOT NULL,
    counted REAL NOT NULL,
    is_over INTEGER NOT NULL,
    record BLOB NOT NULL
);
CREATE INDEX IF NOT EXISTS jobs_by_hold ON jobs (hold, counted);
CREATE INDEX IF NOT EXISTS jobs_open ON jobs (is_over) WHERE NOT is_over;
CREATE TABLE IF NOT EXISTS consents (
    id TEXT PRIMARY KEY,
    job TEXT NOT NULL,
    digest TEXT NOT NULL,
    created REAL NOT NULL,
    expires REAL NOT NULL,
    why TEXT NOT NULL,
    answer TEXT NOT NULL DEFAULT ''
);
CREATE TABLE IF NOT EXISTS facts (
    name TEXT PRIMARY KEY,
    value TEXT NOT NULL
) WITHOUT ROWID;
"""
KEPT: Final = 100_000
"""Jobs that are remembered: of those that are over, the oldest are forgotten."""


FIRST: Final = "0" * 64
"""What stands for the hash of the entry before the first one of a log."""


class Head(NamedTuple):
    """Where a log begins and ends: the number of the first entry that is kept, and the hash of the one before it; the
    number of the last one, its hash, and its line."""

    first: int = 1
    before: str = FIRST
    last: int = 0
    hash: str = FIRST
    line: str = ""


class BudgetHold(StrEnum):
    """What a job does to the budget."""

    NONE = ""
    """Nothing: it waits for a consent, or became no contract."""
    OPEN = "open"
    """It counts, since it may become a contract."""
    SPENT = "spent"
    """It is a contract; it counts for the hour and the day of that."""


class KeptJob(msgspec.Struct, frozen=True, kw_only=True):
    """A job as the file has it. Times are Unix times; `cost` is in the smallest unit, and the most that is paid."""

    id: str
    request: OrderJob
    digest: str
    """The hash of the request, without its note."""
    state: JobState
    objective: str
    model: str
    """Its CID."""
    cost: int
    hold: BudgetHold = BudgetHold.NONE
    robot: str = ""
    robots: tuple[str, ...] | None = None
    """Those that the policy allows it for; None for any."""
    order: str = ""
    """The lasting hash of the demand that was signed last."""
    deadline: int = 0
    """The block before which that can become a contract."""
    until: float = 0.0
    """When no demand is signed any more."""
    contract: str = ""
    result: str = ""
    on_stop: OnStop = ""
    consent: str = ""
    stopped_why: str | None = None
    error: SignerFailure | None = None
    created: float
    changed: float
    revision: int = 0

    @property
    def is_over(self) -> bool:
        return self.state in OVER


class ConsentRecord(msgspec.Struct, frozen=True, kw_only=True):
    """A consent that was asked for; `answer` is `yes`, `no` or `void`, and empty while there is none."""

    id: str
    job: str
    digest: str
    """The hash of what the person sees."""
    created: float
    expires: float
    why: str
    answer: str = ""


class Budget:
    """The file at a path, between `open` and `close`. Used in one event loop. Raises `OSError` and `sqlite3.Error`.

    What was written survives a crash of the program at once, and one of the machine after `sync`.
    """

    def __init__(self, path: Path, *, clock: Callable[[], float] = time.time) -> None:
        self._database = SyncedDatabase(path, SCHEMA)
        self._clock = clock
        self._latest = 0.0
        self._head: Head | None = None

    def open(self, account: str) -> None:
        """Open the file, which belongs to an account (address). Raises `ConfigurationError`."""
        self._database.open()
        owner = self.fact("account")
        if owner not in ("", account):
            self._database.close()
            raise ConfigurationError(
                f"this budget belongs to the account {owner}", hint="name another folder with --data-dir"
            )
        self._latest = float(self.fact("latest") or 0)
        self.keep_fact("account", account)

    def close(self) -> None:
        self._database.close()

    async def sync(self) -> None:
        """Wait until all that was written is on the disk."""
        await self._database.sync()

    def now(self) -> float:
        """The time of day, or the latest one that was seen here, if the clock was set back since."""
        now = self._clock()
        if now > self._latest:
            if now - self._latest > 1.0:
                self.keep_fact("latest", repr(now))
            self._latest = now
        return self._latest

    @property
    def clock_behind(self) -> float:
        """Seconds by which the clock of the machine is behind the latest time that was seen here."""
        return max(0.0, self._latest - self._clock())

    def trust_clock(self) -> None:
        """Take the clock as it is now: the owner says that an earlier one was wrong. Nothing spent becomes free."""
        now = self._clock()
        self._database.write(("UPDATE jobs SET counted = ? WHERE counted > ?", [(now, now)]))
        self.keep_fact("latest", repr(now))
        self._latest = now

    def spending(self, *, besides: str = "") -> Spending:
        """What is spent and bound, without one job (its id)."""
        now = self.now()
        rows = self._database.rows(
            "SELECT cost, hold, counted FROM jobs WHERE id != ?"
            " AND (hold = 'open' OR (hold = 'spent' AND counted > ?))",
            (besides, now - DAY),
        )
        day = sum(int(cost) for cost, _, _ in rows)
        hour = sum(int(cost) for cost, hold, counted in rows if hold == BudgetHold.OPEN or counted > now - HOUR)
        open_jobs = self._database.rows(
            "SELECT COUNT(*) FROM jobs WHERE id != ? AND hold != '' AND NOT is_over", (besides,)
        )
        return Spending(hour, day, open_jobs[0][0])

    def job(self, job_id: str) -> KeptJob | None:
        """The job of an id."""
        return self._one("SELECT record FROM jobs WHERE id = ?", job_id)

    def job_of_key(self, key: str) -> KeptJob | None:
        """The job that was ordered with an idempotency key."""
        return self._one("SELECT record FROM jobs WHERE key = ?", key)

    def jobs(self, limit: int) -> list[KeptJob]:
        """The latest jobs, the newest first."""
        return self._jobs("SELECT record FROM jobs ORDER BY rowid DESC LIMIT ?", limit)

    def open_jobs(self) -> list[KeptJob]:
        """The jobs that are not over, the oldest first; and those that hold a budget although they are."""
        return self._jobs("SELECT record FROM jobs WHERE NOT is_over OR hold = ? ORDER BY rowid", BudgetHold.OPEN)

    def put(self, job: KeptJob, *consents: ConsentRecord) -> KeptJob:
        """Keep a job as it is now, with the next revision, and consents: all or nothing."""
        now = self.now()
        job = msgspec.structs.replace(job, revision=job.revision + 1, changed=now)
        before = self.job(job.id)
        is_new_hold = before is None or before.hold != job.hold
        row = (job.id, job.request.idempotency_key, job.digest, str(job.cost), job.hold, now, job.is_over, encoded(job))
        insert = (
            "INSERT INTO jobs (id, key, digest, cost, hold, counted, is_over, record) VALUES (?, ?, ?, ?, ?, ?, ?, ?)"
            " ON CONFLICT (id) DO UPDATE SET cost = excluded.cost, hold = excluded.hold,"
            f" is_over = excluded.is_over, record = excluded.record{', counted = excluded.counted' * is_new_hold}"
        )
        self._database.write(
            (insert, [row]),
            ("INSERT OR REPLACE INTO consents VALUES (?, ?, ?, ?, ?, ?, ?)", map(msgspec.structs.astuple, consents)),
        )
        if before is None:
            old = "SELECT id FROM jobs WHERE is_over AND hold != 'open' AND counted < ?"
            old += " ORDER BY rowid DESC LIMIT -1 OFFSET ?"
            self._database.write((f"DELETE FROM jobs WHERE id IN ({old})", [(now - 2 * DAY, KEPT)]))
        return job

    def consent(self, consent_id: str) -> ConsentRecord | None:
        """The consent of an id, also one that was answered."""
        rows = self._database.rows("SELECT * FROM consents WHERE id = ?", (consent_id,))
        return _consent(rows[0]) if rows else None

    def consents(self) -> list[ConsentRecord]:
        """The consents that are not answered, the oldest first."""
        return [_consent(row) for row in self._database.rows("SELECT * FROM consents WHERE answer = '' ORDER BY rowid")]

    def fact(self, name: str) -> str:
        """A fact that was kept; empty if none was."""
        rows = self._database.rows("SELECT value FROM facts WHERE name = ?", (name,))
        return str(rows[0][0]) if rows else ""

    def keep_fact(self, name: str, value: str) -> None:
        self._database.write(("INSERT OR REPLACE INTO facts VALUES (?, ?)", [(name, value)]))

    def log_head(self) -> Head:
        """Where the log begins and ends."""
        if self._head is None:
            found = self.fact("log")
            self._head = Head(*decode_json(found, tuple[int, str, int, str, str])) if found else Head()
        return self._head

    def keep_log_head(self, head: Head) -> None:
        self.keep_fact("log", msgspec.json.encode(tuple(head)).decode())
        self._head = head

    def _one(self, statement: str, value: str) -> KeptJob | None:
        return next(iter(self._jobs(statement, value)), None)

    def _jobs(self, statement: str, value: Any) -> list[KeptJob]:
        rows = self._database.rows(statement, (value,))
        return [decode_json(row[0], KeptJob) for row in rows]


def encoded(job: KeptJob) -> bytes:
    """The bytes of a job in the file."""
    return msgspec.json.encode(job)


def _consent(row: tuple[Any, ...]) -> ConsentRecord:
    return ConsentRecord(**dict(zip(ConsentRecord.__struct_fields__, row, strict=True)))
