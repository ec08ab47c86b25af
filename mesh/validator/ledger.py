"""The ledger of a validator: what it was asked to judge, what it signed, and how far it has read the chain.

A juror signs one Result for each liability, and no other one ever: it signs here, and what it signs is on the disk
before anybody sees it. Every write survives `kill -9` once the call has returned.
"""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Any, Final

import msgspec

from mesh.base.database import RoleLedger
from schemas import Liability, Result, decode, encode

if TYPE_CHECKING:
    from collections.abc import Iterable
    from pathlib import Path

    from schemas import Signer

VERDICTS: Final = "verdicts.sqlite"
"""The name of the ledger in an account's folder for a chain."""
SCHEMA: Final = """
CREATE TABLE IF NOT EXISTS verdicts (
    liability TEXT PRIMARY KEY,
    record BLOB NOT NULL,
    since INTEGER NOT NULL,
    result BLOB NOT NULL DEFAULT x'',
    seen INTEGER NOT NULL DEFAULT 0,
    signed BLOB NOT NULL DEFAULT x'',
    report BLOB NOT NULL DEFAULT x'',
    ended INTEGER NOT NULL DEFAULT 0,
    aside INTEGER NOT NULL DEFAULT 0,
    changed REAL NOT NULL
);
CREATE TABLE IF NOT EXISTS marks (mark TEXT NOT NULL, liability TEXT NOT NULL, PRIMARY KEY (mark, liability));
"""
COLUMNS: Final = "record, since, result, seen, signed, report, ended"
STAGE: Final = (
    "CASE WHEN ended THEN 'ended' WHEN signed != x'' THEN 'signed' WHEN result != x'' THEN 'judging' ELSE 'waiting' END"
)
STAGES: Final = ("waiting", "judging", "signed", "ended")
"""Where a verdict is: it waits for the promisor's Result; the result is fetched and judged; the verdict is signed;
the chain has the end."""


class StoredVerdict(msgspec.Struct, frozen=True, kw_only=True):
    """What a juror knows of a liability that names its validator.

    `since_ns` (Unix time) is when the liability was created, `seen_ns` when the Result of its promisor arrived, which
    is empty until then. `signed` is the juror's own Result, `report` its encoded report; both are empty before.
    """

    liability: Liability
    since_ns: int
    result: bytes
    seen_ns: int
    signed: bytes
    report: bytes
    is_ended: bool


class VerdictLedger(RoleLedger):
    """The ledger in the file at `path`, created if missing: `async with VerdictLedger(path, signer) as ledger`.

    Its juror's key has `signer`; without a signer it is only read.
    """

    schema = SCHEMA

    def __init__(self, path: Path, signer: Signer | None = None) -> None:
        super().__init__(path)
        self._signer = signer

    async def open(self, liability: Liability, *, since_ns: int) -> StoredVerdict:
        """Add a liability, or bring back one that was set aside; what is known of it."""
        await self._run(
            "INSERT INTO verdicts (liability, record, since, changed) VALUES (?, ?, ?, ?)"
            " ON CONFLICT (liability) DO UPDATE SET aside = 0 WHERE aside",
            (liability.address, liability.encode(), since_ns, time.time()),
            sync=False,
        )
        found = await self.verdict(liability.address)
        assert found is not None
        return found

    async def set_aside(self, liability: str) -> None:
        """Hide a liability that a reorganisation reverted, until `open` shows it again. Its verdict stays signed."""
        await self._run("UPDATE verdicts SET aside = 1 WHERE liability = ?", (liability,), sync=False)

    async def take(self, liability: str, result: Result, *, seen_ns: int) -> bool:
        """Keep the Result that the promisor has signed. False if there is one already: the first one counts."""
        return await self._run(
            "UPDATE verdicts SET result = ?, seen = ?, changed = ? WHERE liability = ? AND result = x''",
            (encode(result), seen_ns, time.time(), liability),
        )

    async def sign(self, result: Result, *, report: bytes, marks: Iterable[str] = ()) -> StoredVerdict:
        """Sign the Result as the juror judged it, and keep it with its encoded report; what is stored then.

        If the juror has signed one for the liability already, that one stays, whatever `result` says. `marks` identify
        the recording of a success; see `owner_of`.
        """
        assert self._signer is not None, "it was opened to be read"
        signed, address = encode(self._signer.sign(result)), result.liability
        is_new = "WHERE EXISTS (SELECT 1 FROM verdicts WHERE liability = ? AND signed = x'')"
        await self._run_together(
            *((f"INSERT OR IGNORE INTO marks SELECT ?, ? {is_new}", (mark, address, address)) for mark in marks),
            (
                "UPDATE verdicts SET signed = ?, report = ?, changed = ? WHERE liability = ? AND signed = x''",
                (signed, report, time.time(), address),
            ),
        )
        found = await self.verdict(address)
        assert found is not None, "the liability was opened"
        return found

    async def end(self, liability: str, *, ended: bool = True) -> None:
        """The chain has the end of a liability; or not any more, after a reorganisation."""
        await self._run(
            "UPDATE verdicts SET ended = ?, changed = ? WHERE liability = ?",
            (ended, time.time(), liability),
            sync=False,
        )

    async def verdict(self, liability: str) -> StoredVerdict | None:
        """What is known of the liability at this EIP-55 address; None if it does not name this validator."""
        statement = f"SELECT {COLUMNS} FROM verdicts WHERE liability = ? AND NOT aside"
        rows = await self._rows(statement, (liability,))
        return _stored(rows[0]) if rows else None

    async def unended(self) -> list[StoredVerdict]:
        """The liabilities whose end is not on the chain, oldest first."""
        statement = f"SELECT {COLUMNS} FROM verdicts WHERE NOT ended AND NOT aside ORDER BY rowid"
        return [_stored(row) for row in await self._rows(statement)]

    async def owner_of(self, mark: str, *, other_than: str) -> str:
        """The first liability that a recording with this mark succeeded for, `other_than` one; empty without one."""
        statement = "SELECT liability FROM marks WHERE mark = ? AND liability != ? ORDER BY rowid LIMIT 1"
        rows = await self._rows(statement, (mark, other_than))
        return str(rows[0][0]) if rows else ""

    async def stages(self) -> dict[str, int]:
        """The number of liabilities in each of `STAGES`."""
        rows = await self._rows(f"SELECT {STAGE}, COUNT(*) FROM verdicts WHERE NOT aside GROUP BY 1")
        return dict.fromkeys(STAGES, 0) | dict(rows)


def signed_result(stored: StoredVerdict) -> Result:
    result = decode(stored.signed)
    assert isinstance(result, Result)
    return result


def _stored(row: Any) -> StoredVerdict:
    return StoredVerdict(
        liability=Liability.decode(row[0]),
        since_ns=row[1],
        result=row[2],
        seen_ns=row[3],
        signed=row[4],
        report=row[5],
        is_ended=bool(row[6]),
    )
