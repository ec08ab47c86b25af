"""Services of a ROS 2 system: calls of theirs, and services of ours."""

from __future__ import annotations

import asyncio
import logging
import threading
import time
from typing import TYPE_CHECKING, Any, Final, Protocol

import zenoh

from bridges.ros2.attachment import RosAttachment, parse_attachment
from bridges.ros2.errors import RosCallFailed
from bridges.ros2.node import CDR_HEADERS, LARGEST_PAYLOAD
from mesh.background import call_in_loop
from mesh.log_context import log_event
from schemas.errors import AiraError, InvalidPayload

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable

    from bridges.ros2.node import RosNode
    from schemas.payloads import Payload

log = logging.getLogger(__name__)

REQUESTS: Final = 64
"""Requests that a service of ours handles at the same time; others get an error reply."""
FAREWELL: Final = b"the server can't handle this request"


class RosRecorder(Protocol):
    """What records calls: a job."""

    def publish(self, topic: str, message: object) -> None:
        """Record a message on a topic."""


class RosClient:
    """A client of ours of a service."""

    def __init__(self, node: RosNode, name: str, type_name: str, type_hash: str = "") -> None:
        self.name: Final = name
        self.type: Final = type_name
        self._node = node
        self._endpoint = node.endpoint("client", name, type_name, type_hash=type_hash)
        self._endpoint.show()
        self._sequence = 0

    async def call(self, request: object, *, timeout: float | None, job: RosRecorder | None = None) -> Any:
        """Send a request; returns the decoded reply. With `job` both become part of its recording.

        Raises `RosCallFailed` if none comes within `timeout` seconds; None stands for a day. Raises `InvalidPayload`.
        """
        payload = self._node.encoded(f"{self.type}_Request", request)
        if job is not None:
            job.publish(f"{self.name}/_request", payload)
        reply = await self._ask(payload, 86_400.0 if timeout is None else max(timeout, 0.001))
        try:
            answer = self._node.types.decode(f"{self.type}_Response", reply)
        except InvalidPayload as error:
            raise RosCallFailed(self.name, f"its reply does not decode: {error}") from None
        if job is not None:
            job.publish(f"{self.name}/_reply", self._node.payload(f"{self.type}_Response", reply))
        return answer

    def close(self) -> None:
        """Withdraw it. Call it while the session is open."""
        self._endpoint.withdraw()

    async def _ask(self, payload: Payload, timeout: float) -> bytes:
        loop = asyncio.get_running_loop()
        answered: asyncio.Future[bytes | None] = loop.create_future()
        self._sequence += 1
        sequence, attachment = self._sequence, None
        if self._node.flavour.has_attachments:
            attachment = RosAttachment(sequence, time.time_ns(), self._endpoint.gid).encode()

        def settle(reply: bytes | None) -> None:
            if not answered.done():
                answered.set_result(reply)

        def receive(reply: zenoh.Reply) -> None:
            taken = self._accepted(reply, sequence)
            if taken is not None:
                call_in_loop(loop, settle, taken)

        query = zenoh.CancellationToken()
        self._node.session.get(
            self._endpoint.key,
            zenoh.handlers.Callback(receive, lambda: call_in_loop(loop, settle, None), indirect=False),
            target=zenoh.QueryTarget.ALL_COMPLETE,
            consolidation=zenoh.ConsolidationMode.NONE,
            timeout=timeout,
            payload=payload.data,
            attachment=attachment,
            cancellation_token=query,
        )
        try:
            async with asyncio.timeout(timeout):
                reply = await answered
        except TimeoutError:
            reply = None
        finally:
            query.cancel()  # type: ignore[no-untyped-call]
        if reply is None:
            raise RosCallFailed(self.name, f"no usable reply within {timeout:g} s")
        return reply

    def _accepted(self, reply: zenoh.Reply, sequence: int) -> bytes | None:
        """A reply's payload if it answers our request. Runs on Zenoh's thread."""
        if reply.ok is None:
            return None
        attachment = None if reply.ok.attachment is None else parse_attachment(reply.ok.attachment.to_bytes())
        fits = attachment is not None and (attachment.sequence, attachment.gid) == (sequence, self._endpoint.gid)
        if (self._node.flavour.has_attachments and not fits) or len(reply.ok.payload) > LARGEST_PAYLOAD:
            self._node.drops.count("bad-reply", self.name)
            return None
        return reply.ok.payload.to_bytes()


class RosServer:
    """A service of ours. `handler` makes a reply of each decoded request.

    A request that is malformed is dropped, and one too many gets an error reply; `drops` counts both.
    """

    def __init__(
        self, node: RosNode, name: str, type_name: str, handler: Callable[[Any], Awaitable[object]], *, limit: int
    ) -> None:
        self.name: Final = name
        self.type: Final = type_name
        self._node = node
        self._handler = handler
        self._places = threading.Semaphore(limit)
        self._loop = asyncio.get_running_loop()
        self._requests: set[asyncio.Task[None]] = set()
        self._endpoint = node.endpoint("server", name, type_name)
        received = zenoh.handlers.Callback(self._receive, indirect=False)
        self._queryable: Any = node.session.declare_queryable(self._endpoint.key, received, complete=True)
        self._endpoint.show()

    async def close(self) -> None:
        """Withdraw it, and cancel the requests that it handles."""
        if not self._node.session.is_closed():
            self._queryable.undeclare()
            self._endpoint.withdraw()
        for request in self._requests:
            request.cancel()
        if self._requests:
            await asyncio.wait(self._requests)

    def _receive(self, query: zenoh.Query) -> None:
        """Take a request on Zenoh's thread, which refuses what is too much or malformed."""
        if query.payload is None or not 4 <= len(query.payload) <= LARGEST_PAYLOAD:
            self._refuse(query, "bad-request")
            return
        data = query.payload.to_bytes()
        attached = None if query.attachment is None else parse_attachment(query.attachment.to_bytes())
        malformed = data[:2] not in CDR_HEADERS
        if malformed or (attached is None and self._node.flavour.has_attachments):
            self._refuse(query, "bad-request")
        elif not self._places.acquire(blocking=False):
            self._refuse(query, "request")
        else:
            call_in_loop(self._loop, self._accept, query, data, attached)

    def _refuse(self, query: zenoh.Query, reason: str) -> None:
        self._node.drops.count(reason, self.name)
        with query:
            query.reply_err(FAREWELL)

    def _accept(self, query: zenoh.Query, data: bytes, attached: RosAttachment | None) -> None:
        request = asyncio.create_task(self._handle(query, data, attached), name=f"handle {self.name}")
        self._requests.add(request)
        request.add_done_callback(self._ended)

    def _ended(self, request: asyncio.Task[None]) -> None:
        self._requests.discard(request)
        self._places.release()

    async def _handle(self, query: zenoh.Query, data: bytes, attached: RosAttachment | None) -> None:
        with query:
            try:
                request = self._node.types.decode(f"{self.type}_Request", data)
            except InvalidPayload:
                self._refuse(query, "bad-request")
                return
            try:
                reply = self._node.encoded(f"{self.type}_Response", await self._handler(request))
            except Exception as error:
                facts = log_event("ros-request-failed", service=self.name)
                log.error("%s: a request failed: %s", self.name, error, exc_info=_unexpected(error), extra=facts)
                query.reply_err(FAREWELL)
                return
            attachment = None if attached is None else attached._replace(time_ns=time.time_ns()).encode()
            query.reply(self._endpoint.key, reply.data, attachment=attachment)


def _unexpected(error: Exception) -> Exception | None:
    return None if isinstance(error, AiraError) else error
