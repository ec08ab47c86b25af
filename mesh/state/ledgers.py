"""Ledgers as files: a copy of one that is in use, whether one can be used here, and keeping agents out of one.

What is in a ledger is asked of `mesh.work.Ledger`, on a copy.
"""

from __future__ import annotations

import sqlite3
from contextlib import closing, contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from mesh.errors import ConfigurationError
from mesh.state.errors import StateInUse
from mesh.work import Ledger
from mesh.work.database import VERSION, LedgerUnusable
from mesh.work.lifecycle import UNFINISHED
from schemas import Demand, Offer, decode

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping
    from pathlib import Path

    from mesh.work import JobRecord

ACTIVE: Final = (
    "SELECT CASE type WHEN 'table' THEN 'virtual table' ELSE type END FROM sqlite_master"
    " WHERE type IN ('view', 'trigger') OR sql LIKE 'CREATE VIRTUAL%'"
)
"""What would do something when a stranger's ledger is read or written."""
CURSOR: Final = "listener"
"""`mesh.agent.listener.ChainListener.CURSOR`, whose module loads web3."""


@dataclass(frozen=True, kw_only=True)
class LedgerFacts:
    """What a ledger held at one moment. `block` is the last one handled, None before the first."""

    jobs: Mapping[str, JobRecord]
    """Those that are not finalized, by the address of their liability."""
    phases: Mapping[str, int]
    block: int | None
    waiting: int
    """Messages in the outbox."""
    ordered: frozenset[str]
    """CIDs of the objectives of the orders among them."""


def copy_ledger(ledger: Path, copy: Path) -> None:
    """Make a copy of a ledger as it is at this moment, also while an agent writes it; over an earlier copy.

    Raises `LedgerUnusable`, and `ConfigurationError` for one of a newer version.
    """
    try:
        with closing(sqlite3.connect(f"{ledger.resolve().as_uri()}?mode=ro", uri=True)) as source:
            _check_version(source, ledger)
            copy.unlink(missing_ok=True)
            with closing(sqlite3.connect(copy)) as target:
                source.backup(target)
                target.execute("PRAGMA journal_mode = DELETE")  # one file, without a log beside it
    except sqlite3.Error as error:
        raise LedgerUnusable(ledger, error) from None


def check_ledger(ledger: Path) -> None:
    """Raise `LedgerUnusable` for a ledger that is damaged or more than tables, `ConfigurationError` for one of a newer
    version."""
    try:
        with closing(sqlite3.connect(ledger)) as database:
            (found,) = database.execute("PRAGMA integrity_check(1)").fetchone()
            if found != "ok":
                raise LedgerUnusable(ledger, found)
            _check_version(database, ledger)
            if (kind := database.execute(ACTIVE).fetchone()) is not None:
                raise LedgerUnusable(ledger, f"it holds a {kind[0]}, as no ledger does")
    except sqlite3.Error as error:
        raise LedgerUnusable(ledger, error) from None


async def read_ledger(copy: Path) -> LedgerFacts:
    """What a copy holds."""
    async with Ledger(copy) as ledger:
        waiting = [decode(one.payload) for one in await ledger.outbox(head=0)]
        return LedgerFacts(
            jobs={job.liability.address: job for job in await ledger.jobs(UNFINISHED)},
            phases=await ledger.jobs_by_phase(),
            block=await ledger.cursor(CURSOR),
            waiting=len(waiting),
            ordered=frozenset(order.objective for order in waiting if isinstance(order, Demand | Offer)),
        )


@contextmanager
def kept_out(ledger: Path) -> Iterator[None]:
    """Let no agent open a ledger meanwhile. Raises `StateInUse` if one has it open, `LedgerUnusable`."""
    with closing(sqlite3.connect(ledger, timeout=0, isolation_level=None)) as database:
        try:
            database.execute("PRAGMA locking_mode = EXCLUSIVE")
            database.execute("BEGIN EXCLUSIVE")
        except sqlite3.OperationalError as error:
            if getattr(error, "sqlite_errorcode", 0) & 0xFF == sqlite3.SQLITE_BUSY:
                raise StateInUse(ledger) from None
            raise LedgerUnusable(ledger, error) from None
        except sqlite3.DatabaseError:
            pass  # no ledger at all, or one that is damaged: nobody works with it
        yield


def _check_version(database: sqlite3.Connection, ledger: Path) -> None:
    (version,) = database.execute("PRAGMA user_version").fetchone()
    if version > VERSION:
        raise ConfigurationError(
            f"the ledger {ledger} was written by a newer version (format {version}, this one knows {VERSION})",
            hint="upgrade aira-mesh",
        )
