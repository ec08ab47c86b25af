"""Checks are made for themselves, at the same time, within a time; a cause is named once."""

from __future__ import annotations

import asyncio
import threading
from contextlib import aclosing
from typing import TYPE_CHECKING

import pytest

from mesh.base.extras import PackageMissing
from mesh.errors import ConfigurationError, RemoteError
from mesh.ops.doctor import Check, CheckResult, CheckStatus, failed, passed, run_checks, warning
from mesh.ops.doctor.checks import in_thread
from tests.support.waiting import at_most

if TYPE_CHECKING:
    from collections.abc import Sequence


def check(name: str, result: CheckResult, *needs: Sequence[Check]) -> Check:
    async def make() -> CheckResult:
        return result

    return Check(name, make, needs=tuple(map(tuple, needs)))


def failing(name: str, error: BaseException) -> Check:
    async def make() -> CheckResult:
        raise error

    return Check(name, make)


async def made(*checks: Check, seconds: float = 30.0) -> dict[str, CheckResult | None]:
    async with aclosing(run_checks(checks, seconds=seconds)) as examined:
        return {checked.name: checked.result async for checked in examined}


async def test_results_come_in_the_order_of_the_checks() -> None:
    second_is_done = asyncio.Event()

    async def first() -> CheckResult:
        await second_is_done.wait()
        return passed("first")

    async def second() -> CheckResult:
        second_is_done.set()
        return passed("second")

    assert list(await made(Check("one", first), Check("two", second))) == ["one", "two"]


async def test_an_error_is_a_failed_check_with_its_message_and_hint() -> None:
    found = await made(failing("node", RemoteError("nobody there", hint="start it")), check("disk", passed("fine")))

    assert found == {
        "node": CheckResult(CheckStatus.FAIL, "remote-error", "nobody there", "start it"),
        "disk": passed("fine"),
    }


async def test_an_error_without_a_hint_gets_one() -> None:
    (result,) = (await made(failing("node", ConfigurationError("no")))).values()

    assert result is not None
    assert result.hint


async def test_an_unexpected_error_is_raised() -> None:
    with pytest.raises(KeyError, match="a bug"):
        await made(failing("node", KeyError("a bug")))


async def test_a_missing_package_is_named_with_the_extra_that_installs_it() -> None:
    found = await made(failing("node", PackageMissing("web3", extra="chain", user="the chain")))

    assert found["node"] == failed(
        "the chain needs the package web3, which is not installed",
        code="package-missing",
        hint="in a clone of aira-mesh: pip install '.[chain]'",
    )


async def test_checks_that_depend_on_a_failed_one_are_skipped() -> None:
    node = check("node", failed("dead", code="dead", hint="start it"))
    chain = check("chain", passed("never made"), [node])
    account = check("account", passed("never made"), [chain])

    assert await made(node, chain, account) == {"node": node_finding(), "chain": None, "account": None}


def node_finding() -> CheckResult:
    return failed("dead", code="dead", hint="start it")


async def test_one_passed_check_of_a_group_is_enough_and_a_warning_is_no_failure() -> None:
    dead, alive = (
        check("a", failed("dead", code="dead", hint="start it")),
        check("b", warning("old", code="old", hint="renew it")),
    )

    found = await made(dead, alive, check("session", passed("open"), [dead, alive]))

    assert found["session"] == passed("open")


async def test_a_check_without_a_result_in_time_fails_and_delays_no_other() -> None:
    async def never() -> CheckResult:
        await asyncio.Event().wait()
        return passed("never")

    with at_most(5):
        found = await made(Check("slow", never), check("quick", passed("there")), seconds=0.2)

    slow = found["slow"]
    assert slow is not None
    assert (slow.ok, slow.code) == (False, "no-answer")
    assert "--timeout" in slow.hint
    assert found["quick"] == passed("there")


async def test_a_call_that_blocks_for_ever_fails_at_the_timeout() -> None:
    released = threading.Event()

    async def blocked() -> CheckResult:
        await in_thread(released.wait)
        return passed("never")

    with at_most(5):
        found = await made(Check("disk", blocked), seconds=0.2)
    released.set()

    assert found["disk"] is not None
    assert not found["disk"].ok


async def test_an_error_in_a_thread_is_raised() -> None:
    def refuse(words: str) -> None:
        raise RemoteError(words)

    with pytest.raises(RemoteError, match="not now"):
        await in_thread(refuse, "not now")


async def test_closing_the_generator_cancels_the_checks() -> None:
    ended = asyncio.Event()

    async def long() -> CheckResult:
        try:
            await asyncio.Event().wait()
        finally:
            ended.set()
        return passed("never")

    async with aclosing(run_checks([check("one", passed("there")), Check("two", long)], seconds=30)) as examined:
        async for _ in examined:
            break

    assert ended.is_set()
