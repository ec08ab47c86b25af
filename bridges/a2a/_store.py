"""What the door keeps itself, in one file: the contexts of tasks, and where to push their changes."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from a2a.types import TaskPushNotificationConfig
from a2a.utils.errors import InternalError, InvalidParamsError

from mesh.base.database import DISK_ERRORS, SyncedDatabase

if TYPE_CHECKING:
    from pathlib import Path

MOST_CONTEXTS: Final = 20_000
"""Tasks whose context is remembered; the context of others is their id."""
PUSHES_OF_ONE: Final = 4
"""Push notifications of one task …"""
MOST_PUSHES: Final = 128
"""… and of all tasks that are not over."""
_SCHEMA: Final = """
CREATE TABLE IF NOT EXISTS contexts (job TEXT PRIMARY KEY, context TEXT NOT NULL) STRICT;
CREATE TABLE IF NOT EXISTS pushes (
    job TEXT NOT NULL, id TEXT NOT NULL, config BLOB NOT NULL, is_over INTEGER NOT NULL DEFAULT 0,
    PRIMARY KEY (job, id)
) STRICT;
"""


class TaskStore:
    """The file at `path`, between `open` and `close`."""

    def __init__(self, path: Path) -> None:
        self._database = SyncedDatabase(path, _SCHEMA)
        self.open, self.close = self._database.open, self._database.close

    def context(self, job: str) -> str:
        """The context of a job's task."""
        rows = self._database.rows("SELECT context FROM contexts WHERE job = ?", (job,))
        return str(rows[0][0]) if rows else job

    def keep_context(self, job: str, context: str) -> None:
        """Remember the context that a client gave a task, unless it has one."""
        oldest = "DELETE FROM contexts WHERE rowid <= (SELECT MAX(rowid) FROM contexts) - ?"
        self._write(("INSERT OR IGNORE INTO contexts VALUES (?, ?)", [(job, context)]), (oldest, [(MOST_CONTEXTS,)]))

    def pushes(self, job: str) -> list[TaskPushNotificationConfig]:
        """Where the changes of a task are pushed."""
        rows = self._database.rows("SELECT config FROM pushes WHERE job = ? ORDER BY id", (job,))
        return [TaskPushNotificationConfig.FromString(row[0]) for row in rows]

    def waiting(self) -> list[str]:
        """The jobs whose changes are pushed, and that were not over when that was looked at last."""
        return [str(row[0]) for row in self._database.rows("SELECT DISTINCT job FROM pushes WHERE NOT is_over")]

    def push(self, job: str, config: TaskPushNotificationConfig) -> None:
        """Push the changes of a task there, too. Raises `InvalidParamsError` when there are too many."""
        others = [one for one in self.pushes(job) if one.id != config.id]
        in_all = self._database.rows("SELECT COUNT(*) FROM pushes WHERE NOT is_over")
        if len(others) >= PUSHES_OF_ONE or (in_all and in_all[0][0] >= MOST_PUSHES):
            raise InvalidParamsError(f"at most {PUSHES_OF_ONE} push notifications a task, and {MOST_PUSHES} in all")
        old = "DELETE FROM pushes WHERE is_over AND rowid <= (SELECT MAX(rowid) FROM pushes) - 1000"
        values = (job, config.id, config.SerializeToString())
        self._write(("INSERT OR REPLACE INTO pushes (job, id, config) VALUES (?, ?, ?)", [values]), (old, [()]))

    def no_push(self, job: str, identity: str) -> None:
        """Push there no more."""
        self._write(("DELETE FROM pushes WHERE job = ? AND id = ?", [(job, identity)]))

    def over(self, job: str) -> None:
        """The last change of a task was pushed."""
        self._write(("UPDATE pushes SET is_over = 1 WHERE job = ?", [(job,)]))

    async def sync(self) -> None:
        """Wait until all of this is on the disk."""
        await self._database.sync()

    def _write(self, *statements: tuple[str, list[tuple[object, ...]]]) -> None:
        try:
            self._database.write(*statements)
        except DISK_ERRORS as error:
            raise InternalError(f"the disk of this agent refuses: {type(error).__name__}") from None
