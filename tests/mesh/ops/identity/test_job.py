"""A job on a closed site: the members have the rights they need, and changes of the roster do not interrupt it."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Any

from mesh.ops.identity import Member
from tests.support.cli.site import FEE
from tests.support.cli.site import Site as Market
from tests.support.commands import AIRA, Serving
from tests.support.sites import Site
from tests.support.waiting import until

if TYPE_CHECKING:
    from pathlib import Path

    from mesh.ops.identity.certificates import MemberFolder
    from schemas import Demand, Verified
    from tests.support.nodes import Anvil

COST = 500
PATIENCE = 60.0
ROLES = {"robot": "agent", "person": "person", "provider": "provider"}


def tls(folder: MemberFolder) -> dict[str, str]:
    """The settings of the holder of this identity."""
    return {"tls_ca": str(folder.ca), "tls_certificate": str(folder.certificate), "tls_key": str(folder.key)}


def router(site: Site) -> Serving:
    settings = site.settings()
    flags = ("--listen", site.endpoint, "--roster", settings.roster, "--tls-ca", settings.tls_ca)
    own = ("--tls-certificate", settings.tls_certificate, "--tls-key", settings.tls_key)
    return Serving(*AIRA, "router", *flags, *own, says="admitted by certificate")


async def test_a_robot_is_chosen_by_its_price_and_stopped(anvil: Anvil, tmp_path: Path) -> None:
    site = Site(tmp_path / "site")
    market = await Market.found(anvil.url, anvil.private_keys, site.endpoint, tmp_path)
    folders = {
        name: site.enlist(Member(name=name, address=market.address(name), roles=(role,)))  # type: ignore[arg-type]
        for name, role in ROLES.items()
    }
    done: list[str] = []
    robot = market.agent("robot", **tls(folders["robot"]))
    person = market.agent("person", **tls(folders["person"]))
    variables = market.variables("provider", **tls(folders["provider"]))
    provider = Serving(*AIRA, "provider", says="serves ", variables=variables)

    @robot.on_demand
    async def offer(demand: Verified[Demand]) -> None:
        await robot.offer(demand, lighthouse_fee=FEE)

    @robot.on_quote
    def price(request: object) -> int:
        return COST

    @robot.on("/say")
    async def say(job: object, message: Any) -> None:
        done.append(message.data)
        await asyncio.Event().wait()

    async with asyncio.timeout(3 * PATIENCE), router(site), provider, robot, person:
        contract = await person.demand(market.job("word"), cost=2 * COST, robot="cheapest")
        await until(lambda: bool(done), what="the job under way", seconds=PATIENCE)
        assert (contract.robot, contract.liability.cost) == (robot.address, COST)
        await contract.stop("enough")
        assert (await contract.outcome()).reason == "stopped by the customer: enough"


async def test_a_running_job_is_paid_while_one_member_is_revoked_and_another_renewed(
    anvil: Anvil, tmp_path: Path
) -> None:
    site = Site(tmp_path / "site")
    market = await Market.found(anvil.url, anvil.private_keys, site.endpoint, tmp_path)
    folders = {
        name: site.enlist(Member(name=name, address=market.address(name), roles=(role,)))  # type: ignore[arg-type]
        for name, role in ROLES.items()
    }
    site.enlist(Member(name="thief", address="0x" + "0c" * 20, roles=("agent",)))
    done: list[str] = []
    robot, may_work = market.agent("robot", **tls(folders["robot"])), asyncio.Event()
    person = market.agent("person", **tls(folders["person"]))
    variables = market.variables("provider", **tls(folders["provider"]))
    provider = Serving(*AIRA, "provider", says="serves ", variables=variables)

    @robot.on_demand
    async def offer(demand: Verified[Demand]) -> None:
        await robot.offer(demand, lighthouse_fee=FEE)

    @robot.on("/say")
    async def say(job: object, message: Any) -> None:
        done.append(message.data)
        await may_work.wait()

    async with asyncio.timeout(3 * PATIENCE), router(site) as gateway, provider, robot, person:
        before = await person.parts.chain.tokens.balance(market.address("robot"))
        order = await person.demand(market.job("word"), cost=COST)
        await until(lambda: done, what="the job under way", seconds=PATIENCE)

        folders["robot"].renew(site=site.authority, days=1)
        revoked = site.roster.read_text().replace('name = "thief"', 'name = "thief"\nrevoked = true')
        site.roster.write_text(revoked)
        await until(lambda: "roster: 3 members admitted" in gateway.log(), what="the new rules", seconds=PATIENCE)
        may_work.set()

        assert (await order.outcome()).success
        assert done == ["word"]
        assert await person.parts.chain.tokens.balance(market.address("robot")) == before + COST - FEE
