"""A person without ether orders by a permit, and a process is killed between the permit and the contract."""

from __future__ import annotations

import sys
from contextlib import AsyncExitStack
from typing import TYPE_CHECKING, Final

import pytest

from tests.crashes.market import READY
from tests.crashes.matrix import OUTBOX, SENDER, SETTLEMENT, TRADER
from tests.crashes.points import REACHED, Point
from tests.crashes.process import CONTROL, COST, OBJECTIVE, POINT
from tests.support.cli.site import GENERATION_5, Site
from tests.support.commands import Serving
from tests.support.content import ROOT
from tests.support.waiting import until, until_found

if TYPE_CHECKING:
    from pathlib import Path

    from tests.support.nodes import Anvil
    from tests.support.routers import EmbeddedRouter

NOTED: Final = Point("after", "mesh.market._settlement:Settlement.note_permit")
CREATING: Final = Point("before", f"{SETTLEMENT}._create")
SENT: Final = Point("after", f"{SENDER}._send_numbered")
COVERED: Final = Point("after", f"{TRADER}._ensure")
POSTED: Final = Point("after", f"{OUTBOX}.post")
SECONDS: Final = 120.0


@pytest.mark.parametrize(
    ("victim", "point", "generation"),
    [
        pytest.param(victim, point, generation, id=f"{victim}-{point.name}-{generation}")
        for victim, point, generation in (
            ("provider", NOTED, 3),
            ("provider", CREATING, 5),
            ("provider", SENT, 3),
            ("person", COVERED, 5),
            ("person", POSTED, 3),
        )
    ],
)
async def test_a_permit_outlives_a_kill(
    anvil: Anvil, router: EmbeddedRouter, tmp_path: Path, victim: str, point: Point, generation: int
) -> None:
    """Nobody keeps it on a disk: who has an open demand signs and sends one with it again."""
    site = await Site.found(anvil.url, anvil.private_keys, router.endpoint, tmp_path)
    work, person = site.job("work"), site.address("person")
    options = {"log_format": "json", **(GENERATION_5 if generation == 5 else {})}

    def process(role: str, **armed: str) -> Serving:
        variables = site.variables(role, **options) | {OBJECTIVE: str(work), "PYTHONPATH": str(ROOT)} | armed
        return Serving(sys.executable, "-m", "tests.crashes.process", role, says=READY[role], variables=variables)

    async with site.chain("person") as chain:
        await chain.tokens.approve(chain.factory, 0)
        await chain.node.request("anvil_setBalance", person, "0x0")
        sent, had = await chain.node.transaction_count(person, block="latest"), await chain.tokens.balance()
        async with AsyncExitStack() as running:
            started = {}
            for role in ("provider", "robot", "person"):
                armed = {POINT: str(point), CONTROL: str(tmp_path)} if role == victim else {}
                started[role] = await running.enter_async_context(process(role, **armed))
            await until((tmp_path / REACHED).exists, what=str(point), seconds=SECONDS)
            started[victim].kill()
            await running.enter_async_context(process(victim))

            async def is_done() -> bool:
                return any(one.is_finalized for one in await chain.liabilities.list(promisee=person))

            await until_found(is_done, what="the job's end", seconds=SECONDS)
        (contract,) = await chain.liabilities.list(promisee=person)
        assert contract.is_success
        assert await chain.tokens.balance() == had - COST
        assert await chain.tokens.eth_balance() == 0
        assert await chain.node.transaction_count(person, block="pending") == sent
