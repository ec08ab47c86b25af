"""The context of log events: which role logs, and which liability it is about. Tasks and threads inherit it."""

from __future__ import annotations

from contextlib import contextmanager
from contextvars import ContextVar
from functools import wraps
from typing import TYPE_CHECKING, Any, Concatenate, Final, NamedTuple, ParamSpec, TypeVar

from schemas.address import parse_address
from schemas.errors import InvalidAddress

if TYPE_CHECKING:
    from collections.abc import Callable, Coroutine, Iterator

    from schemas import Liability

L = TypeVar("L", bound="str | Liability")
S = TypeVar("S")
T = TypeVar("T")
P = ParamSpec("P")


class LogSource(NamedTuple):
    """The role that logs an event."""

    role: str = ""
    address: str = ""
    """Its account (EIP-55)."""
    lighthouse: str = ""
    """The ENS name of its market."""


UNKNOWN_SOURCE: Final = LogSource()

_source: ContextVar[LogSource] = ContextVar("source", default=UNKNOWN_SOURCE)
_liability: ContextVar[str] = ContextVar("liability", default="")


def current_source() -> LogSource:
    """The role that logs here; `UNKNOWN_SOURCE` outside of any `source_context`."""
    return _source.get()


def current_liability() -> str:
    """The address of the liability that the code here works on; empty outside of any `liability_context`."""
    return _liability.get()


@contextmanager
def source_context(source: LogSource) -> Iterator[None]:
    """Attribute events logged in this context to `source`."""
    token = _source.set(source)
    try:
        yield
    finally:
        _source.reset(token)


@contextmanager
def liability_context(liability: str) -> Iterator[None]:
    """Attach the liability at this address to events logged in this context."""
    token = _liability.set(_checksummed(liability))
    try:
        yield
    finally:
        _liability.reset(token)


def with_liability_context(
    method: Callable[Concatenate[S, L, P], Coroutine[Any, Any, T]],
) -> Callable[Concatenate[S, L, P], Coroutine[Any, Any, T]]:
    """Decorate a method whose first argument is a liability or its address: it runs in that `liability_context`."""

    @wraps(method)
    async def wrapped(self: S, liability: L, /, *arguments: P.args, **options: P.kwargs) -> T:
        with liability_context(liability if isinstance(liability, str) else liability.address):
            return await method(self, liability, *arguments, **options)

    return wrapped


def _checksummed(address: str) -> str:
    """The address as EIP-55 writes it; keys have it in lower case."""
    try:
        return parse_address(address)
    except InvalidAddress:
        return address


def log_event(name: str, /, **fields: object) -> dict[str, Any]:
    """The `extra` of a log call: the event's stable name, and fields for programs to read.

    `log.info("contract created, gas %d", gas, extra=log_event("contract-created", gas=gas))`
    """
    return {"event": name, "facts": {field: str(value) for field, value in fields.items()}}
