"""Services: remote calls to an agent over Zenoh, handled in its event loop (queryables at `aira/agent/…/rpc/…`).

Requests and replies are the JSON of the structs in `schemas.rpc`. An `AiraError` in a handler is sent back as an error
reply, which `call` raises as `ServiceFailed`.
"""

from __future__ import annotations

import asyncio
import logging
import threading
from collections import Counter
from contextlib import asynccontextmanager, contextmanager
from contextvars import copy_context
from functools import partial
from typing import TYPE_CHECKING, Any, Final, Literal, NamedTuple, TypeAlias

import zenoh

from mesh.base.background import Background, call_in_loop
from mesh.base.flood import Drops, Rate, RateLimiter
from mesh.base.lifecycle import Lifecycle
from mesh.base.log_context import log_event
from mesh.errors import AiraError, RemoteError, nearest, public_text
from schemas import InvalidRecord, Record, RpcKey
from schemas.rpc import SERVICES, SPENDING

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Awaitable, Callable, Coroutine, Iterator
    from contextlib import AsyncExitStack

    from schemas.rpc import Service

log = logging.getLogger(__name__)

FailureReason: TypeAlias = Literal["unknown-service", "no-agent", "timeout", "unreadable-reply", "agent-error", "busy"]

TIMEOUT: Final = 10.0
"""Seconds to wait for a reply."""
SPENDING_TIMEOUT: Final = 240.0
"""Seconds to wait for a reply that needs a mined transaction. Calling again too early would pay twice."""


class ServiceLimits(NamedTuple):
    """Requests that an agent handles; more get an error reply."""

    requests: Rate = Rate(20, 300)
    """For one service, a second and at once. Zenoh does not say who asks, and each may cost a call of the node."""
    requests_in_total: Rate = Rate(60, 1000)
    """The same for all services together."""
    at_once: int = 256
    """For one service at the same time."""
    at_once_in_total: int = 1024
    """The same for all services together."""


SERVICE_LIMITS: Final = ServiceLimits()


class Failure(Record, frozen=True):
    """The content of an error reply: the error's message, hint and code (`busy` for a request too many)."""

    error: str
    hint: str = ""
    code: str = ""


BUSY: Final = Failure("the agent is handling too many requests", "try again later", "busy").encode()


class ServiceFailed(RemoteError, code="service-failed"):
    """The agent replied to a call of `service` with an error, or did not reply; `reason` says why.

    The code is `no-answer` if nobody answers at its address: no agent, provider, validator or bridge, or none that
    offers the service.
    """

    def __init__(
        self, message: str, *, service: str, hint: str = "", reason: FailureReason = "agent-error", code: str = ""
    ) -> None:
        super().__init__(message, hint=hint, code=code)
        self.service = service
        self.reason: FailureReason = reason


def no_answer(address: str, service: str = "", *, device: str = "") -> ServiceFailed:
    """The error that nobody answers at an address; with `device`, that its edge agent does not."""
    who = f"the device {device} of {address}" if device else address
    hint = (
        "`aira peers` shows who is present: is it running, on this router and with this lighthouse, and may you ask it?"
    )
    return ServiceFailed(f"{who} does not answer", service=service, hint=hint, reason="no-agent", code="no-answer")


class Services(Lifecycle):
    """The services of the agent at `address`: `async with Services(session, address)`, then `offer` each.

    Requests that are too many get an error reply, and are counted in `drops`. Leaving `async with` withdraws the
    services and cancels requests in progress.
    """

    title = "agent's services"

    def __init__(self, session: zenoh.Session, address: str, *, drops: Drops | None = None) -> None:
        self._drops = Drops() if drops is None else drops
        self._rate = RateLimiter(per_sender=SERVICE_LIMITS.requests, total=SERVICE_LIMITS.requests_in_total)
        self._lock = threading.Lock()
        self._session = session
        self._address = address
        self._running: Counter[str] = Counter()
        """The requests that are being handled, by key; those of all have the empty one."""

    async def _open(self, stack: AsyncExitStack) -> None:
        self._requests = await stack.enter_async_context(Background())

    def offer(self, service: str, handler: Callable[[Any], Awaitable[Record]]) -> None:
        """Reply to requests for `service` (one of `schemas.rpc.SERVICES`) with the result of `handler`.

        Requests are handled concurrently; an `AiraError` of the handler is sent to the caller. Raises `ServiceFailed`
        for an unknown service, `ClosedError` outside `async with`.
        """
        stack = self.check_open()
        loop, key, context = asyncio.get_running_loop(), str(RpcKey(self._address, service)), copy_context()
        handle = partial(_handle, key, _service(service).request, handler)

        def received(query: zenoh.Query) -> None:
            # Zenoh's thread answers what is too much, so that the event loop is not kept busy.
            with self._lock:
                is_accepted = self._has_place(key) and self._rate.allow(service)
            if is_accepted:
                call_in_loop(loop, self._accept, query, key, handle, context=context)
            else:
                self._drops.count("request")
                _refuse(query)

        stack.enter_context(declared(self._session, self._session.declare_queryable(key, received)))

    def _has_place(self, key: str) -> bool:
        return self._running[key] < SERVICE_LIMITS.at_once and self._running[""] < SERVICE_LIMITS.at_once_in_total

    def _accept(self, query: zenoh.Query, key: str, handle: Callable[[zenoh.Query], Coroutine[Any, Any, None]]) -> None:
        if not self.is_open:
            query.drop()  # type: ignore[no-untyped-call]
            return
        if not self._has_place(key):
            _refuse(query)
            return
        self._running.update((key, ""))
        self._requests.start(handle(query), f"handle {key}").add_done_callback(
            lambda _: self._running.subtract((key, ""))
        )


async def _handle(
    key: str, request_type: type[Record], handler: Callable[[Any], Awaitable[Record]], query: zenoh.Query
) -> None:
    with query:
        try:
            payload = b"{}" if query.payload is None else query.payload.to_bytes()
            reply = (await handler(request_type.decode(payload))).encode()
        except AiraError as error:
            query.reply_err(Failure(public_text(error), public_text(error.hint), error.code).encode())
        except Exception:
            log.exception("service %s failed", key, extra=log_event("service-failed", key=key))
            query.reply_err(Failure("the agent failed; see its log").encode())
        else:
            query.reply(key, reply, encoding="application/json")


def _refuse(query: zenoh.Query) -> None:
    """Say that there are too many requests."""
    with query:
        query.reply_err(BUSY)


@contextmanager
def declared(session: zenoh.Session, declaration: Any) -> Iterator[None]:
    """Undeclare a subscriber or a queryable at the end, unless its session is closed, which has none."""
    try:
        yield
    finally:
        if not session.is_closed():
            declaration.undeclare()


@asynccontextmanager
async def answering(
    session: zenoh.Session, selector: str, answer: Callable[[zenoh.Query], Awaitable[None]], rate: Rate, drops: Drops
) -> AsyncIterator[None]:
    """Meanwhile `answer` the queries of a selector, each in a task; those beyond the `rate` are dropped and counted.

    Zenoh does not say who asks, so that all share the rate. An `AiraError` leaves a query without a reply.
    """
    loop, limiter, lock = asyncio.get_running_loop(), RateLimiter(per_sender=rate), threading.Lock()

    async def answer_one(query: zenoh.Query) -> None:
        with query:  # leaving it ends the answer
            try:
                await answer(query)
            except (AiraError, zenoh.ZError) as error:
                log.debug("a query of %s is not answered: %s", query.selector, error)

    async with Background() as tasks:
        is_open = True

        def begin(query: zenoh.Query) -> None:
            if is_open:
                tasks.start(answer_one(query), f"answer {selector}")
            else:  # it came while this ended
                query.drop()  # type: ignore[no-untyped-call]

        def receive(query: zenoh.Query) -> None:
            # Zenoh's thread drops what is too much, so that the event loop is not kept busy.
            with lock:
                is_allowed = limiter.allow("")
            if is_allowed:
                call_in_loop(loop, begin, query)
            else:
                drops.count("recall")
                query.drop()  # type: ignore[no-untyped-call]

        try:
            with declared(session, session.declare_queryable(selector, receive, complete=True)):
                yield
        finally:
            is_open = False


async def call(
    session: zenoh.Session, agent: str, service: str, request: Record, *, timeout: float | None = None
) -> Any:
    """Call `service` (one of `schemas.rpc.SERVICES`) of the agent at `agent` (address) and return its reply.

    Raises `ServiceFailed` with the agent's error, if no such agent offers it, or when no reply arrives within `timeout`
    seconds (by default `TIMEOUT`, or `SPENDING_TIMEOUT` for services that send a transaction). Cancelling stops the
    wait; the agent may complete the request all the same.
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
        try:
            return reply_type.decode(reply.ok.payload.to_bytes())
        except InvalidRecord as error:
            why = f"{service}: unreadable reply: {error}"
            raise ServiceFailed(why, service=service, reason="unreadable-reply") from error
    if reply is None or reply.err is None:
        raise no_answer(agent, service)
    try:
        failure = Failure.decode(reply.err.payload.to_bytes())
    except InvalidRecord:  # Zenoh replies `Timeout`
        raise ServiceFailed(f"{service}: no reply within {timeout:g} s", service=service, reason="timeout") from None
    reason: FailureReason = "busy" if failure.code == "busy" else "agent-error"
    raise ServiceFailed(f"{service}: {failure.error}", service=service, hint=failure.hint, reason=reason)


def _service(name: str) -> Service:
    if name not in SERVICES:
        similar = nearest(name, SERVICES)
        hint = f"did you mean {similar!r}?" if similar else "`aira rpc --list` shows all services"
        raise ServiceFailed(f"{name}: no such service", service=name, reason="unknown-service", hint=hint)
    return SERVICES[name]
