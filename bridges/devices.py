"""What processes that connect a device to its agent share: the job it works for, and marks on what they put."""

from __future__ import annotations

import logging
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, Final

import msgspec

from mesh.base.log_context import log_event
from mesh.errors import AiraError, InvalidKey, public_text
from mesh.telemetry.logs import LogService
from schemas.keys import EventKey, parse_agent_key
from schemas.status import ReadLogs

if TYPE_CHECKING:
    from collections.abc import Iterator

    import zenoh

log = logging.getLogger(__name__)

ABOUT: Final = "/about"
"""The topic on which the process reports which device it serves."""
LOG: Final = "/log"
"""The topic on which the process answers as the service `logs` does."""
CONNECTION: Final = "/aira/device"
"""The topic of a job, followed by the device's name, that records when the device was absent and present."""
PUT_BY_EDGE: Final = b"edge"
"""What the attachment of everything that such a process puts begins with."""


class DeviceTopic(msgspec.Struct, frozen=True):
    """A topic of a device by its name in the mesh. `flow` is as the device sees it: says, hears, serves or asks."""

    name: str
    flow: str
    type: str = ""


class DeviceAbout(msgspec.Struct, frozen=True, kw_only=True):
    """What a device's process replies on `/about`: the device, how it is reached, the job it works for, its topics."""

    name: str = ""
    version: str = ""
    present: bool
    port: str = ""
    job: str = ""
    topics: tuple[DeviceTopic, ...]
    counters: dict[str, int] = {}

    def reply(self, query: zenoh.Query) -> None:
        """Reply to a query with it."""
        with query:
            query.reply(str(query.key_expr), msgspec.json.encode(self), encoding="application/json")


class JobTracker:
    """The agent's jobs that are ready and not complete, in order, as the device sees them."""

    def __init__(self) -> None:
        self._open: list[str] = []

    @property
    def current(self) -> str:
        """The liability (address) that the device works for now: the first one; empty for none."""
        return self._open[0] if self._open else ""

    def begin(self, liability: str) -> None:
        """Make this job the current one: a command named it."""
        self._open = [liability, *(other for other in self._open if other != liability)]

    def handle_event(self, key: str) -> None:
        """Update the jobs by an event of the agent, given its key."""
        try:
            event = parse_agent_key(key)
        except InvalidKey as error:
            log.info("%s", error, extra=log_event("key-ignored", key=key))
            return
        match event:
            case EventKey(event="ready", liability=job) if job not in self._open:
                self._open.append(job)
            case EventKey(event="complete" | "finalized", liability=job) if job in self._open:
                self._open.remove(job)


def said_by(device: str) -> bytes:
    """The attachment of what a device says; its first line if more follows."""
    return PUT_BY_EDGE + b" " + device.encode()


def is_put_by_edge(attachment: zenoh.ZBytes | None) -> bool:
    """Whether a device's process has put something with this attachment."""
    return attachment is not None and attachment.to_bytes().startswith(PUT_BY_EDGE)


def is_said_by_device(attachment: zenoh.ZBytes | None) -> bool:
    """Whether a device has said something with this attachment: it names the device."""
    return attachment is not None and attachment.to_bytes().startswith(PUT_BY_EDGE + b" ")


@contextmanager
def answer_log_queries(session: zenoh.Session, key: str, role: str) -> Iterator[None]:
    """Answer queries for this process's log on a key of the device, as it has no services of its own."""
    service = LogService(role, "")

    def on_query(query: zenoh.Query) -> None:  # on a thread of Zenoh's; the log is in memory
        with query:
            try:
                payload = b"{}" if query.payload is None else query.payload.to_bytes()
                answer = service.read(ReadLogs.decode(payload)).encode()
            except AiraError as error:
                query.reply_err(msgspec.json.encode({"error": public_text(error), "hint": public_text(error.hint)}))
            else:
                query.reply(key, answer, encoding="application/json")

    queryable: Any = session.declare_queryable(key, on_query)
    try:
        yield
    finally:
        if not session.is_closed():
            queryable.undeclare()
