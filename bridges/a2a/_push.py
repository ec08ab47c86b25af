"""Push notifications: posts each change of a task to the addresses that its client has named. And the file in which the
door keeps these, and the contexts of tasks.

A client names any URL, so this is a way to make the door ask machines that only it can reach. It posts to public
addresses only, unless its operator allows others; what it connects to is the address that was checked, and it follows
no redirect.
"""

from __future__ import annotations

import asyncio
import ipaddress
import logging
import socket
from contextlib import suppress
from typing import TYPE_CHECKING, Any, Final, NamedTuple
from urllib.parse import urlsplit

import aiohttp
from a2a.types import StreamResponse, TaskPushNotificationConfig
from a2a.utils.errors import InternalError, InvalidParamsError
from google.protobuf.json_format import MessageToDict

from bridges.a2a._tasks import changes, task_of
from mesh.base.background import Background
from mesh.base.database import DISK_ERRORS, SyncedDatabase
from mesh.base.lifecycle import Lifecycle
from mesh.base.log_context import log_event
from mesh.base.retry import Backoff, RetryPolicy
from mesh.errors import AiraError

if TYPE_CHECKING:
    from contextlib import AsyncExitStack
    from pathlib import Path

    from aiohttp.abc import ResolveResult

    from mesh.signer.client import SignerClient
    from mesh.signer.protocol import Job

log = logging.getLogger(__name__)


class PushLimits(NamedTuple):
    """What push notifications may use."""

    per_task: int = 4
    """Addresses of one task …"""
    in_all: int = 128
    """… and of all tasks that are not over."""
    text: int = 2_000
    """Characters of a URL, and of a secret."""
    at_once: int = 16
    """Posts at once."""
    post: float = 10.0
    """Seconds for one post."""


PUSH_LIMITS: Final = PushLimits()
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
        rows = self._database.rows("SELECT context FROM contexts WHERE job = ?", (job,))
        return str(rows[0][0]) if rows else job

    def keep_context(self, job: str, context: str) -> None:
        """Remember the context that a client gave a task, unless it has one; that of older tasks is their id."""
        oldest = "DELETE FROM contexts WHERE rowid <= (SELECT MAX(rowid) FROM contexts) - ?"
        self._write(("INSERT OR IGNORE INTO contexts VALUES (?, ?)", [(job, context)]), (oldest, [(20_000,)]))

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
        if len(others) >= PUSH_LIMITS.per_task or (in_all and in_all[0][0] >= PUSH_LIMITS.in_all):
            most = f"{PUSH_LIMITS.per_task} push notifications a task, and {PUSH_LIMITS.in_all} in all"
            raise InvalidParamsError(f"at most {most}")
        old = "DELETE FROM pushes WHERE is_over AND rowid <= (SELECT MAX(rowid) FROM pushes) - 1000"
        values = (job, config.id, config.SerializeToString())
        self._write(("INSERT OR REPLACE INTO pushes (job, id, config) VALUES (?, ?, ?)", [values]), (old, [()]))

    def no_push(self, job: str, identity: str) -> None:
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


RETRY: Final = RetryPolicy(initial=1.0, ceiling=20.0, attempts=4)
"""How a change is posted to an address that does not take it."""


def is_public(address: str) -> bool:
    """Whether an IP address is one that anybody can reach: not this machine, a private network, or a special one."""
    try:
        found = ipaddress.ip_address(address.partition("%")[0])
    except ValueError:
        return False
    if isinstance(found, ipaddress.IPv6Address):
        inner = found.ipv4_mapped or found.sixtofour or (found.teredo[1] if found.teredo else None)
        if inner is None and found in ipaddress.ip_network("64:ff9b::/96"):
            inner = ipaddress.ip_address(int(found) & 0xFFFFFFFF)  # type: ignore[assignment]
        if inner is not None:
            return is_public(str(inner))
    return found.is_global and not found.is_multicast


class PublicResolver(aiohttp.ThreadedResolver):
    """Resolves names to public addresses only."""

    async def resolve(
        self, host: str, port: int = 0, family: socket.AddressFamily = socket.AF_INET
    ) -> list[ResolveResult]:
        """The public addresses of a host. Raises `OSError` if it has none."""
        public = [one for one in await super().resolve(host, port, family) if is_public(one["host"])]
        if not public:
            raise OSError("no public address")
        return public


class Pusher(Lifecycle):
    """Pushes the changes of tasks: `async with Pusher(signer, store) as pusher`.

    Entering takes up the tasks of before. Each change is posted at least once, in order, to each of a task's addresses;
    one that does not take it misses it in the end, see `RETRY`. `anywhere` lets it post into private networks.
    """

    title = "push notifications"

    def __init__(self, signer: SignerClient, store: TaskStore, *, anywhere: bool = False) -> None:
        self._signer = signer
        self._store = store
        self._anywhere = anywhere
        self._watched: set[str] = set()
        self._posts = asyncio.Semaphore(PUSH_LIMITS.at_once)

    async def _open(self, stack: AsyncExitStack) -> None:
        connector = aiohttp.TCPConnector(resolver=None if self._anywhere else PublicResolver(), force_close=True)
        timeout = aiohttp.ClientTimeout(total=PUSH_LIMITS.post)
        self._session = await stack.enter_async_context(
            aiohttp.ClientSession(connector=connector, timeout=timeout, cookie_jar=aiohttp.DummyCookieJar())
        )
        self._tasks = await stack.enter_async_context(Background())
        for job in self._store.waiting():
            self.watch(job)

    def check(self, config: TaskPushNotificationConfig) -> None:
        """Raise `InvalidParamsError` for an address that nothing is posted to."""
        text = config.url
        try:
            url = urlsplit(text)
            host, _ = url.hostname or "", url.port
        except ValueError:
            raise InvalidParamsError("the URL of the push notification can't be read") from None
        is_readable = len(text) <= PUSH_LIMITS.text and text.isascii() and text.isprintable()
        if not (host and is_readable) or url.username is not None:
            raise InvalidParamsError("the URL of the push notification is not one to post to")
        if url.scheme != "https" and not (self._anywhere and url.scheme == "http"):
            raise InvalidParamsError("push notifications are sent over HTTPS only")
        if not self._anywhere and (host == "localhost" or (_is_number(host) and not is_public(host))):
            raise InvalidParamsError("push notifications are sent to public addresses only")
        secrets = (config.token, config.authentication.scheme, config.authentication.credentials, config.id)
        if not all(len(one) <= PUSH_LIMITS.text and one.isascii() and (one.isprintable()) for one in secrets):
            raise InvalidParamsError("the token or credentials of the push notification can't be sent in a header")

    def watch(self, job: str) -> None:
        """Push the changes of a job from now on, until it is over."""
        if job not in self._watched:
            self._watched.add(job)
            self._tasks.start(self._follow(job), f"push {job}")

    async def _follow(self, identity: str) -> None:
        try:
            with suppress(AiraError):  # a signer with another state has no such job
                async for job in changes(self._signer, identity):
                    await asyncio.gather(*(self._post(job, one) for one in self._store.pushes(identity)))
            self._store.over(identity)
        finally:
            self._watched.discard(identity)

    async def _post(self, job: Job, config: TaskPushNotificationConfig) -> None:
        body = MessageToDict(StreamResponse(task=task_of(job, self._store.context(job.job_id))))
        headers = {"Content-Type": "application/a2a+json"}
        if config.token:
            headers["X-A2A-Notification-Token"] = config.token
        if config.authentication.scheme and config.authentication.credentials:
            headers["Authorization"] = f"{config.authentication.scheme} {config.authentication.credentials}"
        backoff = Backoff(RETRY)
        while True:
            try:
                if await self._posted(config.url, body, headers):
                    return
            except (aiohttp.ClientError, OSError, TimeoutError, ValueError) as error:
                log.debug("a push notification failed: %s", type(error).__name__)
            if not await backoff.wait():
                break
        facts = log_event("push-not-delivered", job=job.job_id, state=job.state)
        log.warning("the address of a push notification takes none", extra=facts)

    async def _posted(self, url: str, body: dict[str, Any], headers: dict[str, str]) -> bool:
        async with self._posts, self._session.post(url, json=body, headers=headers, allow_redirects=False) as response:
            return 200 <= response.status < 300


def _is_number(host: str) -> bool:
    """Whether a host is an address, also in the forms that only some libraries read, such as `127.1` and `0x7f.1`."""
    try:
        ipaddress.ip_address(host)
    except ValueError:
        last = host.rstrip(".").rpartition(".")[2]
        return last.isdigit() or last.lower().startswith("0x")
    return True
