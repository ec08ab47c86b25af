"""Checks and their results. All checks run concurrently, within one common time limit."""

from __future__ import annotations

import asyncio
import threading
from dataclasses import dataclass
from enum import Enum
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar

from mesh.background import call_in_loop
from mesh.errors import AiraError

if TYPE_CHECKING:
    from collections.abc import AsyncGenerator, Awaitable, Callable, Sequence

T = TypeVar("T")


class CheckStatus(Enum):
    """Whether something works."""

    OK = "ok"
    WARN = "warn"
    """It works now, but needs attention later or for some uses."""
    FAIL = "FAIL"


class CheckResult(NamedTuple):
    """What a check found: a stable `code` for programs, a line for people, and what to do (empty if it passed).

    The code is `ok` for a check that passed in the usual way, and an error's code for one that an error ended.
    """

    status: CheckStatus
    code: str
    message: str
    hint: str = ""

    @property
    def ok(self) -> bool:
        """Whether it works, with or without a warning."""
        return self.status is not CheckStatus.FAIL


def passed(message: str, *, code: str = "ok") -> CheckResult:
    """The check passed."""
    return CheckResult(CheckStatus.OK, code, message)


def warning(message: str, *, code: str, hint: str) -> CheckResult:
    """It works now, but needs attention."""
    return CheckResult(CheckStatus.WARN, code, message, hint)


def failed(message: str, *, code: str, hint: str) -> CheckResult:
    """The check failed."""
    return CheckResult(CheckStatus.FAIL, code, message, hint)


def from_error(error: AiraError) -> CheckResult:
    """An error as a failed check."""
    return failed(
        str(error),
        code=error.code,
        hint=error.hint or "see docs/deploy.md; `aira settings` shows the effective settings",
    )


@dataclass(frozen=True, eq=False)
class Check:
    """Something to check: `run` returns the result; an `AiraError` that it raises is a failed check.

    It runs if at least one check of each group in `needs` has run and not failed. So a cause is reported once,
    not by every check that depends on it.
    """

    name: str
    run: Callable[[], Awaitable[CheckResult]]
    needs: tuple[tuple[Check, ...], ...] = ()


class CompletedCheck(NamedTuple):
    """A check and its result; None if it was skipped because of an earlier failure."""

    name: str
    result: CheckResult | None


async def run_checks(checks: Sequence[Check], *, seconds: float) -> AsyncGenerator[CompletedCheck]:
    """Run the checks and yield each in order, as soon as its result is known.

    A check without a result `seconds` after the start fails. A caller that does not read to the end must close the
    generator.
    """
    deadline = asyncio.get_running_loop().time() + seconds
    tasks: dict[Check, asyncio.Task[CheckResult | None]] = {}
    for check in checks:
        groups = [[tasks[needed] for needed in group] for group in check.needs]
        tasks[check] = asyncio.create_task(_run(check, groups, deadline=deadline, seconds=seconds), name=check.name)
    try:
        for check, task in tasks.items():
            yield CompletedCheck(check.name, await task)
    finally:
        for task in tasks.values():
            task.cancel()
        await asyncio.gather(*tasks.values(), return_exceptions=True)


async def in_thread(function: Callable[..., T], *arguments: Any) -> T:
    """Run a blocking function in a daemon thread.

    Unlike `asyncio.to_thread`, the end of the program does not wait for it: a dead name server or disk can hold a call
    for minutes.
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


async def _run(
    check: Check, groups: list[list[asyncio.Task[CheckResult | None]]], *, deadline: float, seconds: float
) -> CheckResult | None:
    for group in groups:
        if not any(result is not None and result.ok for result in [await needed for needed in group]):
            return None
    try:
        async with asyncio.timeout_at(deadline) as limit:
            return await check.run()
    except AiraError as error:
        return from_error(error)
    except TimeoutError:
        if not limit.expired():
            raise
        return failed(
            f"no answer within {seconds:g} s", code="no-answer", hint="try a longer --timeout if it may be slow"
        )
