"""The ledger of a validator: one signature for each liability, whatever happens."""

from __future__ import annotations

import asyncio
import stat
from typing import TYPE_CHECKING

import pytest

from mesh.validator.ledger import VerdictLedger, signed_result
from schemas import Result, encode, verify_message
from tests.support.agent.samples import liability
from tests.support.orders import OBJECTIVE, RECORDING, ROBOT, STRANGER

if TYPE_CHECKING:
    from collections.abc import AsyncIterator
    from pathlib import Path

JUROR = STRANGER


@pytest.fixture
async def ledger(tmp_path: Path) -> AsyncIterator[VerdictLedger]:
    async with VerdictLedger(tmp_path / "verdicts.sqlite", JUROR) as opened:
        yield opened


def result_of(name: str = "one", *, success: bool = True, recording: str = RECORDING) -> Result:
    return ROBOT.sign(Result(liability=liability(name).address, result=recording, success=success))


async def judged(ledger: VerdictLedger, name: str = "one", *, marks: tuple[str, ...] = ()) -> None:
    await ledger.open(liability(name), since_ns=1)
    await ledger.take(liability(name).address, result_of(name), seen_ns=2)
    await ledger.sign(result_of(name), report=b"{}", marks=marks)


async def test_the_first_result_of_the_promisor_counts(ledger: VerdictLedger) -> None:
    await ledger.open(liability(), since_ns=7)
    address = liability().address
    assert await ledger.take(address, result_of(), seen_ns=8)
    assert not await ledger.take(address, result_of(recording=OBJECTIVE), seen_ns=9)
    stored = await ledger.verdict(address)
    assert stored is not None
    assert (stored.result, stored.since_ns, stored.seen_ns) == (encode(result_of()), 7, 8)


async def test_a_juror_signs_once_for_each_liability(ledger: VerdictLedger) -> None:
    await ledger.open(liability(), since_ns=1)
    first = await ledger.sign(result_of(success=False), report=b"first")
    second = await ledger.sign(result_of(success=True), report=b"second")
    assert first == second
    signed = verify_message(signed_result(second))
    assert (signed.signer, signed.message.success, second.report) == (JUROR.address, False, b"first")


async def test_two_verdicts_at_once_are_one(ledger: VerdictLedger) -> None:
    await ledger.open(liability(), since_ns=1)
    both = await asyncio.gather(*(ledger.sign(result_of(success=value), report=b"{}") for value in (True, False)))
    assert both[0].signed == both[1].signed


async def test_it_remembers_in_a_private_file(tmp_path: Path) -> None:
    path = tmp_path / "verdicts.sqlite"
    async with VerdictLedger(path, JUROR) as ledger:
        await judged(ledger)
        await ledger.set_cursor(12, history=b"history")
    async with VerdictLedger(path, JUROR) as again:
        stored = await again.sign(result_of(success=False), report=b"other")
        assert signed_result(stored).success
        assert await again.cursor() == (12, b"history")
        assert [one.liability for one in await again.unended()] == [liability()]
    assert stat.S_IMODE(path.stat().st_mode) == 0o600


async def test_a_reverted_liability_is_set_aside_with_what_was_signed(ledger: VerdictLedger) -> None:
    await judged(ledger)
    await ledger.set_aside(liability().address)
    assert await ledger.verdict(liability().address) is None
    assert await ledger.unended() == []
    back = await ledger.open(liability(), since_ns=5)
    assert (back.since_ns, signed_result(back).success) == (1, True)


async def test_it_knows_for_which_liability_a_recording_succeeded(ledger: VerdictLedger) -> None:
    one, two = liability("one").address, liability("two").address
    await ledger.open(liability("two"), since_ns=1)
    assert await ledger.owner_of(RECORDING, other_than=two) == ""
    await judged(ledger, "one", marks=(RECORDING, "hash"))
    assert await ledger.owner_of("hash", other_than=two) == one
    assert await ledger.owner_of(RECORDING, other_than=one) == ""
    await ledger.sign(result_of("one"), report=b"{}", marks=("late",))  # the verdict stands already
    assert await ledger.owner_of("late", other_than=two) == ""


async def test_stages(ledger: VerdictLedger) -> None:
    await judged(ledger, "one")
    await judged(ledger, "two")
    await ledger.end(liability("two").address)
    for name in ("three", "four"):
        await ledger.open(liability(name), since_ns=1)
    await ledger.take(liability("four").address, result_of("four"), seen_ns=2)
    assert await ledger.stages() == {"signed": 1, "ended": 1, "waiting": 1, "judging": 1}
    await ledger.end(liability("two").address, ended=False)
    assert (await ledger.stages())["signed"] == 2
