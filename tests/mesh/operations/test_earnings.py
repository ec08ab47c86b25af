"""What `aira provider` says of its earnings, against what its account has on the chain."""

from __future__ import annotations

import asyncio
import logging
from typing import TYPE_CHECKING

from mesh.cli import provider as command
from mesh.market.earnings import Earnings, EarningsLedger
from tests.mesh.operations.site import FEE, Site
from tests.support.waiting import until

if TYPE_CHECKING:
    from pathlib import Path

    import pytest

    from mesh.chain import Chain
    from tests.support.nodes import Anvil
    from tests.support.routers import EmbeddedRouter

COST = 10**9
"""More than the gas of a job is worth, which bounds what is minted for it."""


async def test_what_it_says_is_what_the_account_gained_and_lost(
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
        serving = asyncio.create_task(command._serve(settings))
        async with asyncio.timeout(60):
            for word in ("one", "two"):
                contract = await person.demand(site.job(word), cost=COST)
                assert (await contract.outcome()).success
        await until(lambda: caplog.text.count("finalized, success True") == 2, seconds=30)
        serving.cancel()
        await asyncio.wait([serving])
        gained, spent = await chain.tokens.balance() - xrt, wei - await chain.tokens.eth_balance()
        gas = await gas_used(chain, start)
    earned = Earnings(
        created=2, finalized=2, rejected={}, gas_used=gas, spent=spent, fees=2 * FEE, minted=gained - 2 * FEE
    )
    assert earned.minted > 2 * 200_000
    assert said(caplog) == [str(earned)]


async def gas_used(chain: Chain, start: int) -> int:
    """What all transactions after a block took; only the provider sends any."""
    numbers = range(start + 1, await chain.block_number() + 1)
    blocks = [await chain.node.request("eth_getBlockByNumber", hex(number), False) for number in numbers]
    return sum(int(block["gasUsed"], 16) for block in blocks)


def said(caplog: pytest.LogCaptureFixture) -> list[str]:
    """What the command has logged."""
    return [record.getMessage() for record in caplog.records if record.name == command.__name__]


async def test_news_of_it_are_told_now_and_then(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(command, "REPORT", 0.01)
    caplog.set_level(logging.INFO, command.__name__)
    books = EarningsLedger()
    reporting = asyncio.create_task(command._report(books.earnings))
    await until(lambda: len(said(caplog)) == 1)
    await asyncio.sleep(0.2)
    assert len(said(caplog)) == 1, "nothing has changed"
    books.rejected("full")
    await until(lambda: len(said(caplog)) == 2)
    reporting.cancel()
    await asyncio.wait([reporting])
    assert said(caplog)[2:] == [str(books.earnings())]
