"""The earnings that `aira provider` logs, compared with its account on the chain."""

from __future__ import annotations

import asyncio
import logging
from typing import TYPE_CHECKING

from msgspec.structs import asdict

from mesh.cli import provider as command
from mesh.market import _settlement
from mesh.market._earnings import Earnings, EarningsLedger
from tests.support.cli.site import FEE, Site
from tests.support.waiting import until

if TYPE_CHECKING:
    from pathlib import Path

    import pytest

    from mesh.chain import Chain
    from tests.support.nodes import Anvil
    from tests.support.routers import EmbeddedRouter

COST = 10**9
"""More than the gas of a job is worth; the cost limits what is minted for the gas."""


async def test_logged_earnings_equal_the_gains_and_costs_of_the_account(
    anvil: Anvil, router: EmbeddedRouter, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO)
    site = await Site.found(anvil.url, anvil.private_keys, router.endpoint, tmp_path)
    variables = site.variables("provider")
    settings = site.settings(
        "provider",
        keyfile=variables["AIRA_KEYFILE"],
        keyfile_password_file=variables["AIRA_KEYFILE_PASSWORD_FILE"],
    )
    async with site.chain("provider") as chain, site.robot([]), site.agent("person") as person:
        start, xrt, wei = await chain.block_number(), await chain.tokens.balance(), await chain.tokens.eth_balance()
        serving = asyncio.create_task(command.serve(settings))
        async with asyncio.timeout(60):
            for word in ("one", "two"):
                contract = await person.demand(site.job(word), cost=COST)
                assert (await contract.outcome()).success
        # A contract may be finalized before the provider has read the receipt of its creation.
        await until(lambda: created(caplog) == finalized(caplog) == 2, seconds=30)
        serving.cancel()
        await asyncio.wait([serving])
        gained, spent = await chain.tokens.balance() - xrt, wei - await chain.tokens.eth_balance()
        gas = await gas_used(chain, start)
    earned = Earnings(
        created=2, finalized=2, rejected={}, gas_used=gas, spent=spent, fees=2 * FEE, minted=gained - 2 * FEE
    )
    assert earned.minted > 2 * 200_000
    assert reports(caplog) == [fields_of(earned)]


async def gas_used(chain: Chain, start: int) -> int:
    """The gas of all transactions after a block; only the provider sends any."""
    numbers = range(start + 1, await chain.block_number() + 1)
    blocks = [await chain.node.request("eth_getBlockByNumber", hex(number), False) for number in numbers]
    return sum(int(block["gasUsed"], 16) for block in blocks)


def created(caplog: pytest.LogCaptureFixture) -> int:
    """The number of contracts that the provider knows to have created; agents log this event, too."""
    records = [record for record in caplog.records if getattr(record, "event", "") == "contract-created"]
    return sum(record.name == _settlement.__name__ for record in records)


def finalized(caplog: pytest.LogCaptureFixture) -> int:
    """The number of contracts that were finalized with success."""
    records = [record for record in caplog.records if getattr(record, "event", "") == "contract-finalized"]
    return sum(record.facts["success"] == "True" for record in records)  # type: ignore[attr-defined]


def reports(caplog: pytest.LogCaptureFixture) -> list[dict[str, str]]:
    """The fields of the reports that the command has logged; it logs nothing else here."""
    records = [vars(record) for record in caplog.records if record.name == command.__name__]
    assert all(record["event"] == "earnings-reported" for record in records)
    return [record["facts"] for record in records]


def fields_of(earnings: Earnings) -> dict[str, str]:
    """The fields of a report; `rejected` is the number of all rejections."""
    fields = asdict(earnings) | {"rejected": sum(earnings.rejected.values())}
    return {name: str(value) for name, value in fields.items()}


async def test_changed_earnings_are_logged_regularly(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO, command.__name__)
    ledger = EarningsLedger()
    reporting = asyncio.create_task(command.report_earnings(ledger.earnings, interval=0.01))
    await until(lambda: len(reports(caplog)) == 1)
    await asyncio.sleep(0.2)
    assert len(reports(caplog)) == 1, "nothing has changed"
    ledger.rejected("full")
    await until(lambda: len(reports(caplog)) == 2)
    reporting.cancel()
    await asyncio.wait([reporting])
    assert reports(caplog)[2:] == [fields_of(ledger.earnings())]
