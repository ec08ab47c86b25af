"""What an event of the log is about: who speaks, and the contract that it concerns. Tasks and threads inherit it."""

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
    """Whose event it is."""

    role: str = ""
    address: str = ""
    """Its account (EIP-55)."""
    lighthouse: str = ""
    """The ENS name of its market."""


NOBODY: Final = LogSource()

_speaker: ContextVar[LogSource] = ContextVar("speaker", default=NOBODY)
_liability: ContextVar[str] = ContextVar("liability", default="")


def speaker() -> LogSource:
    """Who speaks here; `NOBODY` where that is not said."""
    return _speaker.get()


def liability() -> str:
    """The address of the contract that is dealt with here; empty if there is none."""
    return _liability.get()


@contextmanager
def source_context(who: LogSource) -> Iterator[None]:
    """What is logged within is said by `who`."""
    token = _speaker.set(who)
    try:
        yield
    finally:
        _speaker.reset(token)


@contextmanager
def liability_context(liability: str) -> Iterator[None]:
    """What is logged within concerns the contract at the address `liability`."""
    token = _liability.set(_canonical(liability))
    try:
        yield
    finally:
        _liability.reset(token)


def with_liability_context(
    method: Callable[Concatenate[S, L, P], Coroutine[Any, Any, T]],
) -> Callable[Concatenate[S, L, P], Coroutine[Any, Any, T]]:
    """Decorate a method whose first argument is a liability, or the address of one: its events concern that."""

    @wraps(method)
    async def concerned(self: S, which: L, /, *arguments: P.args, **options: P.kwargs) -> T:
        with liability_context(which if isinstance(which, str) else which.address):
            return await method(self, which, *arguments, **options)

    return concerned


def _canonical(address: str) -> str:
    """The address as EIP-55 writes it: keys have it in small letters."""
    try:
        return parse_address(address)
    except InvalidAddress:
        return address


def log_event(name: str, /, **fields: object) -> dict[str, Any]:
    """The `extra` of a log call: the event's stable name, and fields for programs to read.

    `log.info("contract created, gas %d", gas, extra=log_event("contract-created", gas=gas))`
    """
    return {"event": name, "facts": {field: str(value) for field, value in fields.items()}}
