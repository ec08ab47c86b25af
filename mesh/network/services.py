"""Services: questions to an agent over Zenoh, answered in its event loop; the queryables of `aira/agent/…/rpc/…`.

Requests and replies are the JSON of the structs in `schemas.rpc`. An `AiraError` travels back as an error reply and is
raised again where the question was asked.
"""

from __future__ import annotations

import asyncio
import difflib
import logging
from contextvars import copy_context
from functools import partial
from typing import TYPE_CHECKING, Any, Final, Self

import zenoh

from mesh.errors import AiraError, ClosedError, RemoteError
from mesh.network.crossing import call_in_loop
from schemas import InvalidRecord, Record, RpcKey
from schemas.rpc import SERVICES, SPENDING

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable
    from types import TracebackType

    from schemas.rpc import Service

log = logging.getLogger(__name__)

TIMEOUT: Final = 10.0
"""Seconds to wait for an answer."""
SPENDING_TIMEOUT: Final = 240.0
"""Seconds to wait for an answer that is given when a transaction is mined: who asks again too early pays twice."""
AT_ONCE: Final = 256
"""Questions that an agent answers at the same time; whoever asks more is told to come again."""


class Failure(Record, frozen=True):
    """What an error reply holds: the error's line and what to do about it."""

    error: str
    hint: str = ""


BUSY: Final = Failure("the agent is answering too many questions", "ask again later").encode()


class ServiceFailed(RemoteError):
    """The agent that was asked answered with an error, or did not answer; `service` is what was asked."""

    code = "service-failed"

    def __init__(self, service: str, why: str, *, hint: str = "") -> None:
        super().__init__(f"{service}: {why}", hint=hint)
        self.service = service


class Services:
    """The services of the agent at `address`: `async with Services(session, address)`, then `offer` each.

    Leaving `async with` withdraws them and breaks off what is not answered yet.
    """

    def __init__(self, session: zenoh.Session, address: str) -> None:
        self._session = session
        self._address = address
        self._queryables: list[Any] = []
        self._answers: set[asyncio.Task[None]] = set()
        self._open = False

    async def __aenter__(self) -> Self:
        self._open = True
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._open = False
        queryables, self._queryables = self._queryables, []
        if not self._session.is_closed():
            for queryable in queryables:
                queryable.undeclare()
        for answer in self._answers:
            answer.cancel()
        if self._answers:
            await asyncio.wait(self._answers)

    def offer(self, service: str, handler: Callable[[Any], Awaitable[Record]]) -> None:
        """Answer `service` (one of `schemas.rpc.SERVICES`) with what `handler` makes of each request.

        Requests are handled concurrently; an `AiraError` of the handler travels to who asked. Raises `ServiceFailed`
        for a service that there isn't, `ClosedError` outside `async with`.
        """
        if not self._open:
            raise ClosedError("the services are not open", hint="use them inside `async with`")
        loop, request_type = asyncio.get_running_loop(), _service(service).request
        key, context = str(RpcKey(self._address, service)), copy_context()

        def asked(query: zenoh.Query) -> None:
            call_in_loop(loop, self._answer_soon, query, key, request_type, handler, context=context)

        self._queryables.append(self._session.declare_queryable(key, asked))

    def _answer_soon(
        self, query: zenoh.Query, key: str, request_type: type[Record], handler: Callable[[Any], Awaitable[Record]]
    ) -> None:
        if not self._open:
            query.drop()  # type: ignore[no-untyped-call]
            return
        if len(self._answers) >= AT_ONCE:
            with query:
                query.reply_err(BUSY)
            return
        answer = asyncio.create_task(self._answer(query, key, request_type, handler), name=f"answer {key}")
        self._answers.add(answer)
        answer.add_done_callback(self._answers.discard)

    async def _answer(
        self, query: zenoh.Query, key: str, request_type: type[Record], handler: Callable[[Any], Awaitable[Record]]
    ) -> None:
        with query:
            try:
                payload = b"{}" if query.payload is None else query.payload.to_bytes()
                reply = (await handler(request_type.decode(payload))).encode()
            except AiraError as error:
                query.reply_err(Failure(str(error), error.hint).encode())
            except Exception:
                log.exception("service %s failed", key)
                query.reply_err(Failure("the agent failed; its log says why").encode())
            else:
                query.reply(key, reply, encoding="application/json")


async def call(
    session: zenoh.Session, agent: str, service: str, request: Record, *, timeout: float | None = None
) -> Any:
    """Ask `service` (one of `schemas.rpc.SERVICES`) of the agent at `agent` (address); its reply is that service's.

    Raises `ServiceFailed` with the agent's own words, or that nobody answers within `timeout` seconds (by default
    `TIMEOUT`, or `SPENDING_TIMEOUT` for what sends a transaction). Cancelling ends the asking; what was asked may be
    done all the same.
    """
    if timeout is None:
        timeout = SPENDING_TIMEOUT if service in SPENDING else TIMEOUT
    key, reply_type = str(RpcKey(agent, service)), _service(service).reply
    asking = zenoh.CancellationToken()
    get = partial(session.get, key, payload=request.encode(), encoding="application/json", timeout=timeout)
    try:
        reply = await asyncio.to_thread(lambda: next(iter(get(cancellation_token=asking)), None))
    finally:
        asking.cancel()  # type: ignore[no-untyped-call]
    if reply is not None and reply.ok is not None:
        return _read(service, reply_type, reply.ok.payload.to_bytes())
    if reply is not None and reply.err is not None:
        raise _failed(service, reply.err.payload.to_bytes(), timeout)
    raise ServiceFailed(service, "nobody answers", hint="is the agent running, and on the same router?")


def _service(name: str) -> Service:
    if name not in SERVICES:
        nearest = difflib.get_close_matches(name, SERVICES, n=1, cutoff=0)[0]
        raise ServiceFailed(name, "there is no such service", hint=f"did you mean {nearest!r}?")
    return SERVICES[name]


def _read(service: str, reply_type: type[Record], payload: bytes) -> Record:
    try:
        return reply_type.decode(payload)
    except InvalidRecord as error:
        raise ServiceFailed(service, f"the answer can't be read: {error}") from error


def _failed(service: str, payload: bytes, timeout: float) -> ServiceFailed:
    try:
        failure = Failure.decode(payload)
    except InvalidRecord:
        return ServiceFailed(service, f"no answer within {timeout:g} s")  # Zenoh's own reply says `Timeout`
    return ServiceFailed(service, failure.error, hint=failure.hint)
