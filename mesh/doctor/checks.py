"""Making checks: all at the same time, each for itself, within a time for all of them."""

from __future__ import annotations

import asyncio
import threading
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final, NamedTuple, TypeVar

from mesh.doctor.findings import Finding, broken, of_error
from mesh.errors import AiraError
from mesh.network import call_in_loop

if TYPE_CHECKING:
    from collections.abc import AsyncGenerator, Awaitable, Callable, Sequence

T = TypeVar("T")

EXTRAS: Final = {
    "web3": "chain",
    "eth_account": "chain",
    "eth_abi": "chain",
    "eth_keyfile": "chain",
    "aiohttp": "chain,ipfs",
    "cryptography": "identity",
    "serial": "serial",
    "cobs": "serial",
}
"""Packages that not every machine has, and the extra of ours that brings each."""


@dataclass(frozen=True, eq=False)
class Check:
    """Something to look at: `make` says what it found; an `AiraError` that it raises is a finding, too.

    It is made when of each group in `needs` at least one check was made and has not failed. So a cause is named once,
    and not again by all that depends on it.
    """

    name: str
    make: Callable[[], Awaitable[Finding]]
    needs: tuple[tuple[Check, ...], ...] = ()


class Checked(NamedTuple):
    """A check, and what came of it: None if it could not be made."""

    name: str
    finding: Finding | None


async def examine(checks: Sequence[Check], *, seconds: float) -> AsyncGenerator[Checked]:
    """Make the checks; each is yielded in its turn, as soon as it is known.

    One that has no answer `seconds` after the beginning fails. Whoever does not read to the end closes the generator.
    """
    ends = asyncio.get_running_loop().time() + seconds
    tasks: dict[Check, asyncio.Task[Finding | None]] = {}
    for check in checks:
        groups = [[tasks[needed] for needed in group] for group in check.needs]
        tasks[check] = asyncio.create_task(_made(check, groups, ends=ends, seconds=seconds), name=check.name)
    try:
        for check, task in tasks.items():
            yield Checked(check.name, await task)
    finally:
        for task in tasks.values():
            task.cancel()
        await asyncio.gather(*tasks.values(), return_exceptions=True)


async def aside(function: Callable[..., T], *arguments: Any) -> T:
    """What a function that blocks returns, or raises. It runs in a thread that nobody waits for in the end.

    A dead name server or disk holds a call for minutes; the program ends before.
    """
    loop = asyncio.get_running_loop()
    outcome: asyncio.Future[T] = loop.create_future()

    def settle(result: T | None, error: BaseException | None) -> None:
        if outcome.done():
            return
        if error is not None:
            outcome.set_exception(error)
        else:
            outcome.set_result(result)  # type: ignore[arg-type]

    def run() -> None:
        result, raised = None, None
        try:
            result = function(*arguments)
        except BaseException as error:
            raised = error
        call_in_loop(loop, settle, result, raised)

    threading.Thread(target=run, name=getattr(function, "__name__", "check"), daemon=True).start()
    return await outcome


async def _made(
    check: Check, groups: list[list[asyncio.Task[Finding | None]]], *, ends: float, seconds: float
) -> Finding | None:
    for group in groups:
        if not any(finding is not None and finding.ok for finding in [await needed for needed in group]):
            return None
    try:
        async with asyncio.timeout_at(ends) as limit:
            return await check.make()
    except AiraError as error:
        return of_error(error)
    except TimeoutError:
        if not limit.expired():
            raise
        return broken(f"no answer within {seconds:g} s", do="a longer --timeout tells a slow one from a dead one")
    except ModuleNotFoundError as error:
        if (extra := EXTRAS.get((error.name or "").partition(".")[0])) is None:
            raise
        return broken(f"this needs {error.name}, which is not installed here", do=f"pip install 'aira-mesh[{extra}]'")
