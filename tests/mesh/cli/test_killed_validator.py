"""A validator process that is killed with `kill -9` at work: the cost is refunded, or it goes on and is paid once."""

from __future__ import annotations

import asyncio
import json
import sys
from contextlib import asynccontextmanager
from typing import TYPE_CHECKING, Any, Final

import pytest

from mesh.chain import DeploymentPlan
from tests.support.cli.site import GENERATION_5, MODEL, Site, has_event
from tests.support.commands import AIRA, SECONDS, Serving, aira, refused
from tests.support.waiting import until, until_found

if TYPE_CHECKING:
    from collections.abc import AsyncIterator
    from pathlib import Path

    from tests.support.nodes import Anvil
    from tests.support.routers import EmbeddedRouter

pytestmark = pytest.mark.full

COST: Final = 7
FEE: Final = 100
REFUND_DELAY: Final = 60
"""Blocks."""
PATIENT: Final = """
import time
from pathlib import Path
from mesh import Validator
validator = Validator()
@validator.check("patient", description="It waits until the test lets it go on.")
def patient(evidence):
    print("it checks", flush=True)
    while not Path({gate!r}).exists():
        time.sleep(0.02)
    return True
validator.run()
"""


class Judged:
    """A market in which a jury of one judges, and a job in it. All but the robot are processes."""

    def __init__(self, site: Site, jury: str) -> None:
        self.site = site
        self.jury = jury
        self.robot = site.agent("robot", **GENERATION_5 | {"generation": 5})
        self.may_work = asyncio.Event()
        self.robot.on_demand(self.robot.offer)
        self.robot.on("/say")(self._work)

    @classmethod
    async def found(cls, anvil: Anvil, endpoint: str, folder: Path) -> Judged:
        plan = DeploymentPlan(timeout_blocks=100, refund_delay=REFUND_DELAY)
        site = await Site.found(anvil.url, anvil.private_keys, endpoint, folder, plan=plan)
        words = ("validator", "deploy", "--juror", site.address("validator"), "--json")
        done = await asyncio.to_thread(aira, *words, **site.variables("person", **GENERATION_5))
        return cls(site, json.loads(done.stdout)["validator"])

    async def aira(self, *words: str, by: str = "person") -> Any:
        return await asyncio.to_thread(aira, *words, **self.site.variables(by, **GENERATION_5))

    def validator(self, *command: str | Path) -> Serving:
        """`aira validator`, or a program."""
        own = {"validator_contract": self.jury, "validator_fee": f"{FEE}wn", "log_format": "json"}
        variables = self.site.variables("validator", **GENERATION_5 | own)
        return Serving(*(command or (*AIRA, "validator")), says='"validator-started"', variables=variables)

    def demand(self) -> Serving:
        """`aira demand`, which is ready once the contract is made."""
        terms = ("--model", MODEL, "--objective", self.site.job("word"), "--cost", f"{COST}wn")
        variables = self.site.variables("person", **GENERATION_5)
        return Serving(*AIRA, "demand", *terms, "--validator", self.jury, says="\ncontract 0x", variables=variables)

    async def balances(self) -> dict[str, int]:
        """By role, and of the jury."""
        async with self.site.chain("person") as chain:
            accounts = {role: self.site.address(role) for role in ("person", "robot")} | {"jury": self.jury}
            return {name: await chain.tokens.balance(account) for name, account in accounts.items()}

    @asynccontextmanager
    async def paid_once(self) -> AsyncIterator[None]:
        """After this, the robot and the jury have what the person has not any more, and `aira demand` has ended."""
        before = await self.balances()
        expected = {
            "person": before["person"] - COST - FEE,
            "robot": before["robot"] + COST,
            "jury": before["jury"] + FEE,
        }
        yield

        async def is_paid() -> bool:
            return await self.balances() == expected

        await until_found(is_paid, what="one payment", seconds=SECONDS)

    async def _work(self, job: Any, message: Any) -> None:
        await self.may_work.wait()


@pytest.fixture
async def judged(anvil: Anvil, router: EmbeddedRouter, tmp_path: Path) -> Judged:
    return await Judged.found(anvil, router.endpoint, tmp_path)


def address_in(said: str) -> str:
    """The contract that `aira demand` has printed."""
    return next(line for line in said.splitlines() if line.startswith("contract ")).split()[1]


async def test_the_cost_is_refunded_if_the_validator_is_killed_before_it_judges(judged: Judged) -> None:
    before = await judged.balances()
    async with judged.site.provider(), judged.robot, judged.validator() as validator, judged.demand() as demand:
        address = address_in(demand.log())
        await asyncio.to_thread(validator.kill)
        judged.may_work.set()
        held = await judged.balances()
        assert held == before | {"person": before["person"] - COST - FEE}
        said = f"\nthe validator {judged.jury} is silent: 0 of 1 needed jurors has judged; refund possible from block "
        await asyncio.to_thread(demand.wait_until_said, said)
        block = int(demand.log().partition(said)[2].split()[0].replace(",", ""))

        shown = await judged.aira("liability", "show", address, "--json")
        assert (json.loads(shown.stdout)["refundableFrom"], json.loads(shown.stdout)["reports"]) == (block, [])
        refund = ("liability", "cancel", address, "--refund")
        refused(await judged.aira(*refund, by="rival"), "not-refundable", f"{block:,}")
        async with judged.site.chain("rival") as chain:
            await chain.node.request("anvil_mine", hex(block - await chain.block_number()))
        assert await asyncio.to_thread(demand.wait) == 1  # the person's own agent has taken the refund
        assert "no verdict of the validator" in demand.log()
    assert await judged.balances() == before


async def test_a_validator_that_is_killed_during_its_check_checks_again(judged: Judged, tmp_path: Path) -> None:
    gate, program = tmp_path / "gate", tmp_path / "patient.py"
    program.write_text(PATIENT.format(gate=str(gate)))
    judged.may_work.set()
    async with judged.site.provider(), judged.robot, judged.validator(sys.executable, program) as validator:
        async with judged.paid_once(), judged.demand() as demand:
            address = address_in(demand.log())
            await asyncio.to_thread(validator.wait_until_said, "it checks")
            await asyncio.to_thread(validator.kill)
            gate.touch()
            await asyncio.to_thread(validator.start)
            assert await asyncio.to_thread(demand.wait) == 0
        assert "it checks" in validator.log()
        assert has_event(validator, "verdict-signed", liability=address)


async def test_a_validator_that_is_killed_after_its_check_sends_what_it_signed(judged: Judged) -> None:
    """The provider is away, so that the verdict has no effect before."""
    async with judged.site.provider() as provider, judged.robot, judged.validator() as validator:
        async with judged.paid_once(), judged.demand() as demand:
            address = address_in(demand.log())
            await asyncio.to_thread(provider.stop)
            judged.may_work.set()
            await until(lambda: has_event(validator, "verdict-signed", success="True"), seconds=SECONDS)
            await asyncio.to_thread(validator.kill)
            await asyncio.to_thread(provider.start)
            await asyncio.to_thread(validator.start)
            assert await asyncio.to_thread(demand.wait) == 0
        assert has_event(validator, "case-opened", liability=address)
        assert not has_event(validator, "verdict-signed")
