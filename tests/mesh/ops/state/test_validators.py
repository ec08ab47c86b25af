"""The ledger of a validator in backups."""

from __future__ import annotations

from typing import TYPE_CHECKING

from mesh.errors import ConfigurationError
from mesh.ops.state import back_up, examine_archive, restore, take_inventory
from mesh.validator.ledger import VERDICTS, VerdictLedger
from schemas import Result
from tests.mesh.ops.state.conftest import CHAIN
from tests.support.agent.samples import liability
from tests.support.orders import RECORDING, STRANGER
from tests.support.raising import raises_with

if TYPE_CHECKING:
    from pathlib import Path

JUROR = STRANGER
PLACE = f"{JUROR.address}/{CHAIN}/{VERDICTS}"


async def judged(folder: Path) -> None:
    async with VerdictLedger(folder / PLACE, JUROR) as ledger:
        await ledger.open(liability(), since_ns=1)
        await ledger.sign(Result(liability=liability().address, result=RECORDING, success=True), report=b"{}")
        await ledger.set_cursor(7)


async def test_a_validators_ledger_is_backed_up_and_restored(tmp_path: Path) -> None:
    await judged(tmp_path / "data")
    (account,) = (await take_inventory(tmp_path / "data")).accounts
    assert [(chain.chain, chain.block, chain.verdicts) for chain in account.chains] == [(CHAIN, 7, {"signed": 1})]

    await back_up(tmp_path / "data", tmp_path / "backup", content="needed")
    assert examine_archive(tmp_path / "backup").files == {"verdicts": 1}
    await restore(tmp_path / "backup", tmp_path / "other")
    async with VerdictLedger(tmp_path / "other" / PLACE, JUROR) as ledger:
        stored = await ledger.verdict(liability().address)
        assert stored is not None
        assert stored.signed


async def test_the_ledger_of_a_running_validator_is_not_replaced(tmp_path: Path) -> None:
    await judged(tmp_path)
    await back_up(tmp_path, tmp_path / "backup", content="none")
    async with VerdictLedger(tmp_path / PLACE, JUROR) as ledger:
        await ledger.set_cursor(8)
        with raises_with(ConfigurationError, code="state-in-use"):
            await restore(tmp_path / "backup", tmp_path, set_aside=True)
