"""What a signer keeps: its budget, which must not be forgotten, and its log, which must not be changed.

`Budget` is one SQLite file: orders by their keys, what they cost, consents, and the head of the log. What an order may
cost is in it, and on the disk, before anything is signed. An order counts until it is known that it became no contract;
what it cost then counts for the hour and the day of its contract, also if that is refunded. Time only moves forward
here: a clock that is set back frees nothing.

`SignerLog` says what programs asked for, what was allowed and refused, what people said, and what came of it. Each
entry is a line of JSON with a number, the hash of the entry before and the account's signature. The budget has the last
entry and the number of the first one that is kept, so an entry that was changed, removed, added, or cut off at either
end is found. An entry is in the budget before it is in the file: one that a crash keeps from the file is written when
the log is opened again.
"""

from __future__ import annotations

import os
import re
import time
from datetime import UTC, datetime
from enum import StrEnum
from itertools import pairwise
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import msgspec

from mesh.base.database import SyncedDatabase
from mesh.base.private_files import make_private_folder, open_private, sync_directory, sync_file
from mesh.errors import ConfigurationError
from mesh.signer.policy import DAY, HOUR, Spending
from mesh.signer.protocol import OVER, JobState, OnStop, OrderJob, SignerFailure
from schemas.address import keccak256
from schemas.decoding import InvalidData, decode_json
from schemas.errors import AiraError
from schemas.signing import recover

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path

    from schemas import Signer

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


_NAME: Final = re.compile(r"log-(\d{12})\.jsonl")


class SignedEntry(msgspec.Struct, frozen=True, kw_only=True):
    """An entry: `time` is Unix time, `previous` the hash of the entry before. The `signature` is over `hash`."""

    number: int
    time: float
    event: str
    facts: dict[str, Any]
    previous: str
    signature: str = ""

    @property
    def digest(self) -> bytes:
        """What is signed: the hash of all but the signature."""
        return keccak256(b"aira log\0" + msgspec.json.encode(msgspec.structs.replace(self, signature="")))

    @property
    def hash(self) -> str:
        """The digest, 64 hexadecimal digits."""
        return self.digest.hex()


class SignerLog:
    """The log in a folder, signed by an account. `budget` is the open database that has its head.

    After `file_bytes` another file is begun; of more than `files` the oldest goes.
    """

    def __init__(
        self, folder: Path, signer: Signer, budget: Budget, *, file_bytes: int = 4 << 20, files: int = 16
    ) -> None:
        self.folder = folder
        self._signer = signer
        self._budget = budget
        self._file_bytes = file_bytes
        self._files = files

    def open(self) -> None:
        """Write the last entry to its file if a crash kept it from that. Raises `AiraError`, `OSError`."""
        make_private_folder(self.folder)
        head = self._budget.log_head()
        if not head.last:
            return
        path = self._paths()[-1] if self._paths() else self._path_of(head.last)
        data = path.read_bytes() if path.exists() else b""
        whole, torn = data.rpartition(b"\n")[0], data.rpartition(b"\n")[2]
        last = whole.rpartition(b"\n")[2].decode(errors="replace")
        if last == head.line and not torn:
            return
        number = _number_in(last)
        if (number == head.last - 1 or (not whole and head.last == head.first)) and head.line.encode().startswith(torn):
            with open(path, "wb" if not whole else "r+b", opener=open_private) as file:
                file.truncate(len(data) - len(torn))
                file.seek(0, os.SEEK_END)
                file.write(head.line.encode() + b"\n")
            sync_file(path)
            sync_directory(self.folder)
            return
        raise AiraError(
            f"the signer's log was changed: entry {head.last} is not the last one",
            hint="`aira mcp log --verify` says where; keep the folder for inquiry, and begin with another --data-dir",
            code="log-unusable",
        )

    def add(self, event: str, **facts: Any) -> SignedEntry:
        """Add an entry. It survives a crash of the program at once, and one of the machine after `Budget.sync`.

        Raises `OSError`, `sqlite3.Error`.
        """
        head = self._budget.log_head()
        entry = SignedEntry(number=head.last + 1, time=self._budget.now(), event=event, facts=facts, previous=head.hash)
        entry = msgspec.structs.replace(entry, signature=self._signer.sign_hash(entry.digest).hex())
        line = msgspec.json.encode(entry)
        path, first, before = self._place(head)
        self._budget.keep_log_head(Head(first, before, entry.number, entry.hash, line.decode()))
        with open(path, "ab", opener=open_private) as file:
            file.write(line + b"\n")
        return entry

    def entries(self, first: int | None = None, limit: int = 100) -> list[SignedEntry]:
        """Up to `limit` entries from a number on, or the latest. Blocks on the disk. Raises `AiraError`."""
        head = self._budget.log_head()
        start = max(head.first, head.last - limit + 1 if first is None else first)
        found: list[SignedEntry] = []
        paths = self._paths()
        for path, following in zip(paths, [*paths[1:], None], strict=True):
            if following is not None and _first_of(following) <= start:
                continue
            for line in _lines(path):
                entry = _decoded(line)
                if entry is None:
                    hint = "`aira mcp log --verify` says where"
                    raise AiraError("the signer's log was changed", hint=hint, code="log-unusable")
                if entry.number >= start:
                    found.append(entry)
                if len(found) == limit:
                    return found
        return found

    def _place(self, head: Head) -> tuple[Path, int, str]:
        """The file of the next entry; and the first entry that is kept, and the hash before it."""
        paths = self._paths()
        if paths and paths[-1].stat().st_size < self._file_bytes:
            return paths[-1], head.first, head.before
        path = self._path_of(head.last + 1)
        first, before = head.first, head.before
        for old, following in pairwise(paths):
            if len(paths) < self._files:
                break
            if (entry := next((_decoded(line) for line in _lines(following)), None)) is not None:
                first, before = entry.number, entry.previous
            self._budget.keep_log_head(Head(first, before, head.last, head.hash, head.line))
            old.unlink()
            break
        return path, first, before

    def _paths(self) -> list[Path]:
        return log_files(self.folder)

    def _path_of(self, number: int) -> Path:
        return self.folder / f"log-{number:012d}.jsonl"


def log_files(folder: Path) -> list[Path]:
    """The files of a log, the oldest first."""
    return sorted(path for path in folder.iterdir() if _NAME.fullmatch(path.name)) if folder.is_dir() else []


def verify_log(folder: Path, signer: str, head: Head, *, latest: Callable[[], int] | None = None) -> str:
    """What is wrong with the log of an account (address) whose head is known; an empty text if nothing is.

    The log may grow meanwhile if `latest` says which entry is the last one by then. Blocks on the disk, and takes about
    a tenth of a millisecond an entry.
    """
    number, previous = head.first, head.before
    for path in log_files(folder):
        for line in _lines(path):
            entry = _decoded(line)
            if entry is None:
                return f"entry {number} is unreadable ({path.name})"
            if entry.number != number:
                return f"entry {number} is missing: entry {entry.number} follows {number - 1}"
            if entry.previous != previous:
                return f"entry {number} does not follow entry {number - 1}: one of them was changed"
            try:
                by = recover(entry.digest, bytes.fromhex(entry.signature))
            except (AiraError, ValueError):
                by = ""
            if by != signer:
                return f"entry {number} was changed: it is not signed by {signer}"
            number, previous = number + 1, entry.hash
            if entry.number == head.last and previous != head.hash:
                return f"entry {head.last} is another one than the database says"
    last = head.last if latest is None else latest()
    if not head.last <= number - 1 <= last:
        return f"the log ends with entry {number - 1}, and entry {last} was the last one"
    return ""


def time_text(unix: float) -> str:
    """A time as ISO 8601 in UTC."""
    return datetime.fromtimestamp(unix, UTC).isoformat(timespec="milliseconds").replace("+00:00", "Z")


def _lines(path: Path) -> Iterator[bytes]:
    with path.open("rb") as file:
        while line := file.readline((1 << 16) + 2):
            yield line.removesuffix(b"\n")


def _decoded(line: bytes) -> SignedEntry | None:
    """The entry in a line; None for what is none, or written in another way than it is."""
    try:
        entry = decode_json(line, SignedEntry)
    except InvalidData:
        return None
    return entry if msgspec.json.encode(entry) == line else None


def _number_in(line: str) -> int:
    entry = _decoded(line.encode()) if line else None
    return 0 if entry is None else entry.number


def _first_of(path: Path) -> int:
    found = _NAME.fullmatch(path.name)
    assert found is not None
    return int(found[1])
