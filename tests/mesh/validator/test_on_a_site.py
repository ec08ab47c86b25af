"""`aira validator` as a process: on a closed site with a real node, and its errors at the start."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Any

import pytest

from mesh.agent.agent import Agent
from mesh.amounts import InvalidAmount
from mesh.ops.identity import Member
from tests.mesh.ops.identity.test_job import router, tls
from tests.support.cli.site import MODEL, QUICK_RESEND, events, has_event
from tests.support.cli.site import Site as Market
from tests.support.commands import AIRA, Serving, invoke, refused
from tests.support.sites import Site
from tests.support.waiting import until_found

if TYPE_CHECKING:
    from pathlib import Path

    from mesh.errors import AiraError
    from schemas import Demand, Verified
    from tests.support.nodes import Anvil

ROLES = {"robot": "agent", "person": "person", "provider": "provider", "validator": "validator"}
PATIENCE = 60.0


class JudgedMarket:
    """A market on a closed site whose jobs a jury of one judges, in generation 5."""

    def __init__(self, market: Market, folders: dict[str, Any], contract: str) -> None:
        self.market = market
        self.contract = contract
        self._folders = folders

    @classmethod
    async def found(cls, node: Anvil, site: Site, folder: Path) -> JudgedMarket:
        market = await Market.found(node.url, node.private_keys, site.endpoint, folder)
        folders = {
            name: site.enlist(Member(name=name, address=market.address(name), roles=(role,)))  # type: ignore[arg-type]
            for name, role in ROLES.items()
        }
        async with market.chain("person") as chain:
            made = await chain.validators.deploy([market.address("validator")], 1)
        return cls(market, folders, made.address)

    def process(self, role: str, **options: str) -> Serving:
        """`aira provider` or `aira validator`, not yet started."""
        variables = self.market.variables(role, log_format="json", **tls(self._folders[role]), **options)
        return Serving(*AIRA, role, says=f'"{role}-started"', variables=variables)

    def validator(self) -> Serving:
        return self.process("validator", validator_contract=self.contract, validator_policies="acknowledged,schema")

    def agent(self, role: str) -> Agent:
        settings = self.market.settings(role, generation=5, **tls(self._folders[role]))
        return Agent(MODEL, settings=settings, account=self.market.accounts[role], resend=QUICK_RESEND)

    def robot(self) -> Agent:
        robot = self.agent("robot")

        @robot.on_demand
        async def offer(demand: Verified[Demand]) -> None:
            await robot.offer(demand)

        @robot.on("/say")
        def say(job: Any, message: Any) -> None:
            job.publish("/said", message.data)

        return robot


async def test_a_site_s_jobs_are_judged_also_by_a_validator_that_was_killed(anvil: Anvil, tmp_path: Path) -> None:
    site = Site(tmp_path / "site")
    judged = await JudgedMarket.found(anvil, site, tmp_path)
    robot, person = judged.robot(), judged.agent("person")
    async with asyncio.timeout(3 * PATIENCE):
        async with router(site), judged.process("provider"), robot, person, judged.validator() as validator:
            first = await person.demand(judged.market.job("one"), cost=500, validator=judged.contract)
            assert (await first.outcome()).success
            assert has_event(validator, "verdict-signed", success="True")
            await until_found(first.reports, what="the report")
            await asyncio.to_thread(validator.kill)
            order = await person.order(judged.market.job("two"), cost=500, validator=judged.contract, validator_fee=0)
            second = await order.contract()
            await asyncio.to_thread(validator.start)
            assert (await second.outcome()).success
            (signed,) = [event for event in events(validator.log()) if event["event"] == "verdict-signed"]
            assert signed["liability"] == second.address


@pytest.mark.parametrize(
    ("options", "error"),
    [
        ({"validator_policies": "nonsense"}, "invalid-policy"),
        ({"validator_fee": "much"}, InvalidAmount),
        ({"validator_title": "no account"}, "account-not-set"),
    ],
)
def test_what_it_can_t_start_with_is_one_line(options: dict[str, str], error: type[AiraError] | str) -> None:
    refused(invoke("validator", **{f"AIRA_{name.upper()}": value for name, value in options.items()}), error)
