"""The service `logs`: the last events of a role, for whoever may ask.

It changes nothing and is open like `status`: on a router without a roster to everybody on the machine, on a closed site
to operators. No event holds a key or a password.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from mesh.errors import AiraError
from mesh.telemetry.logs import own_log

if TYPE_CHECKING:
    from schemas.logs import LogsRead, ReadLogs


class NoLog(AiraError):
    """A program that embeds the role writes its log in its own way."""

    code = "no-log"


class LogService:
    """`logs` of the role `role` with the account `address`. Of a process with several, each tells its own events."""

    def __init__(self, role: str, address: str) -> None:
        self._role = role
        self._address = address

    async def logs(self, asked: ReadLogs) -> LogsRead:
        """The events asked for. Raises `NoLog`, `InputError`."""
        return self.read(asked)

    def read(self, asked: ReadLogs) -> LogsRead:
        """The same, for who has no event loop."""
        own = own_log()
        if own is None:
            raise NoLog(
                f"this {self._role} is part of a program that keeps no log",
                hint="the program may call mesh.telemetry.logs.keep_log()",
            )
        return own.ring.read(asked, address=self._address, role=self._role)
