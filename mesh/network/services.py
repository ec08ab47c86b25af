"""Services: remote calls to an agent over Zenoh, handled in its event loop (queryables at `aira/agent/…/rpc/…`).

Requests and replies are the JSON of the structs in `schemas.rpc`. An `AiraError` in a handler is sent back as an error
reply, which `call` raises as `ServiceFailed`.
"""

from __future__ import annotations

import asyncio
import logging
import threading
from collections import Counter
from contextvars import copy_context
from functools import partial
from typing import TYPE_CHECKING, Any, Final, Literal, Self, TypeAlias

import zenoh

from mesh.background import call_in_loop
from mesh.errors import AiraError, ClosedError, RemoteError
from mesh.flood import Rate, RateLimiter
from mesh.log_context import log_event
from mesh.suggestions import nearest
from schemas import InvalidRecord, Record, RpcKey
from schemas.rpc import SERVICES, SPENDING

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable

    from mesh.flood import Drops
    from schemas.rpc import Service

log = logging.getLogger(__name__)

FailureReason: TypeAlias = Literal["unknown-service", "no-agent", "timeout", "unreadable-reply", "agent-error", "busy"]

TIMEOUT: Final = 10.0
"""Seconds to wait for a reply."""
SPENDING_TIMEOUT: Final = 240.0
"""Seconds to wait for a reply that needs a mined transaction. Calling again too early would pay twice."""
CONCURRENT_REQUESTS: Final = 256
"""Requests for one service that an agent handles at the same time; more get an error reply."""
CONCURRENT_IN_TOTAL: Final = 1024
"""The same for all services together."""
REQUESTS: Final = Rate(20, 300)
"""Requests for one service that an agent handles, a second and at once; more get an error reply. Zenoh does not say who
asks, and each may cost a call of the node."""
REQUESTS_IN_TOTAL: Final = Rate(60, 1000)
"""The same for all services together."""


class Failure(Record, frozen=True):
    """The content of an error reply: the error's message, hint and code (`busy` for a request too many)."""

    error: str
    hint: str = ""
    code: str = ""


BUSY: Final = Failure("the agent is handling too many requests", "try again later", "busy").encode()


class ServiceFailed(RemoteError, code="service-failed"):
    """The agent replied to a call of `service` with an error, or did not reply; `reason` says why."""

    def __init__(self, service: str, why: str, *, hint: str = "", reason: FailureReason = "agent-error") -> None:
        super().__init__(f"{service}: {why}", hint=hint)
        self.service = service
        self.reason: FailureReason = reason


class Services:
    """The services of the agent at `address`: `async with Services(session, address)`, then `offer` each.

    Requests that are too many get an error reply, and are counted in `drops`. Leaving `async with` withdraws the
    services and cancels requests in progress.
    """

    def __init__(self, session: zenoh.Session, address: str, *, drops: Drops | None = None) -> None:
        self._drops = drops
        self._rate = RateLimiter(per_sender=REQUESTS, total=REQUESTS_IN_TOTAL)
        self._lock = threading.Lock()
        self._session = session
        self._address = address
        self._queryables: list[Any] = []
        self._requests: set[asyncio.Task[None]] = set()
        self._running: Counter[str] = Counter()
        """The requests that are being handled, by key."""
        self._open = False

    async def __aenter__(self) -> Self:
        self._open = True
        return self

    async def __aexit__(self, *exc_info: object) -> None:
        self._open = False
        queryables, self._queryables = self._queryables, []
        if not self._session.is_closed():
            for queryable in queryables:
                queryable.undeclare()
        for request in self._requests:
            request.cancel()
        if self._requests:
            await asyncio.wait(self._requests)

    @property
    def in_progress(self) -> int:
        """The requests that are being handled."""
        return len(self._requests)

    def offer(self, service: str, handler: Callable[[Any], Awaitable[Record]]) -> None:
        """Reply to requests for `service` (one of `schemas.rpc.SERVICES`) with the result of `handler`.

        Requests are handled concurrently; an `AiraError` of the handler is sent to the caller. Raises `ServiceFailed`
        for an unknown service, `ClosedError` outside `async with`.
        """
        if not self._open:
            raise ClosedError("the services are not open", hint="use them inside `async with`")
        loop, request_type = asyncio.get_running_loop(), _service(service).request
        key, context = str(RpcKey(self._address, service)), copy_context()

        def received(query: zenoh.Query) -> None:
            # Zenoh's thread answers what is too much, so that the event loop is not kept busy.
            if self._has_place(key) and self._allow(service):
                call_in_loop(loop, self._accept, query, key, request_type, handler, context=context)
                return
            if self._drops is not None:
                self._drops.count("request")
            with query:
                query.reply_err(BUSY)

        self._queryables.append(self._session.declare_queryable(key, received))

    def _has_place(self, key: str) -> bool:
        return self._running[key] < CONCURRENT_REQUESTS and len(self._requests) < CONCURRENT_IN_TOTAL

    def _allow(self, service: str) -> bool:
        with self._lock:
            return self._rate.allow(service)

    def _accept(
        self, query: zenoh.Query, key: str, request_type: type[Record], handler: Callable[[Any], Awaitable[Record]]
    ) -> None:
        if not self._open:
            query.drop()  # type: ignore[no-untyped-call]
            return
        if not self._has_place(key):
            with query:
                query.reply_err(BUSY)
            return
        request = asyncio.create_task(self._handle(query, key, request_type, handler), name=f"handle {key}")
        self._requests.add(request)
        self._running[key] += 1
        request.add_done_callback(partial(self._ended, key))

    def _ended(self, key: str, request: asyncio.Task[None]) -> None:
        self._requests.discard(request)
        self._running[key] -= 1

    async def _handle(
        self, query: zenoh.Query, key: str, request_type: type[Record], handler: Callable[[Any], Awaitable[Record]]
    ) -> None:
        with query:
            try:
                payload = b"{}" if query.payload is None else query.payload.to_bytes()
                reply = (await handler(request_type.decode(payload))).encode()
            except AiraError as error:
                query.reply_err(Failure(str(error), error.hint, error.code).encode())
            except Exception:
                log.exception("service %s failed", key, extra=log_event("service-failed", key=key))
                query.reply_err(Failure("the agent failed; see its log").encode())
            else:
                query.reply(key, reply, encoding="application/json")


async def call(
    session: zenoh.Session, agent: str, service: str, request: Record, *, timeout: float | None = None
) -> Any:
    """Call `service` (one of `schemas.rpc.SERVICES`) of the agent at `agent` (address) and return its reply.

    Raises `ServiceFailed` with the agent's error, or when no reply arrives within `timeout` seconds (by default
    `TIMEOUT`, or `SPENDING_TIMEOUT` for services that send a transaction). Cancelling stops the wait; the agent may
    complete the request all the same.
    """
    if timeout is None:
        timeout = SPENDING_TIMEOUT if service in SPENDING else TIMEOUT
    key, reply_type = str(RpcKey(agent, service)), _service(service).reply
    query = zenoh.CancellationToken()
    get = partial(session.get, key, payload=request.encode(), encoding="application/json", timeout=timeout)
    try:
        reply = await asyncio.to_thread(lambda: next(iter(get(cancellation_token=query)), None))
    finally:
        query.cancel()  # type: ignore[no-untyped-call]
    if reply is not None and reply.ok is not None:
        return _read(service, reply_type, reply.ok.payload.to_bytes())
    if reply is not None and reply.err is not None:
        raise _failed(service, reply.err.payload.to_bytes(), timeout)
    raise ServiceFailed(
        service, "no agent answers", reason="no-agent", hint="is the agent running, and on the same router?"
    )


def _service(name: str) -> Service:
    if name not in SERVICES:
        similar = nearest(name, SERVICES)
        hint = f"did you mean {similar!r}?" if similar else "`aira rpc --list` shows all services"
        raise ServiceFailed(name, "no such service", reason="unknown-service", hint=hint)
    return SERVICES[name]


def _read(service: str, reply_type: type[Record], payload: bytes) -> Record:
    try:
        return reply_type.decode(payload)
    except InvalidRecord as error:
        raise ServiceFailed(service, f"unreadable reply: {error}", reason="unreadable-reply") from error


def _failed(service: str, payload: bytes, timeout: float) -> ServiceFailed:
    try:
        failure = Failure.decode(payload)
    except InvalidRecord:
        return ServiceFailed(service, f"no reply within {timeout:g} s", reason="timeout")  # Zenoh replies `Timeout`
    reason: FailureReason = "busy" if failure.code == "busy" else "agent-error"
    return ServiceFailed(service, failure.error, hint=failure.hint, reason=reason)
