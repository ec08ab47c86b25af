"""Orders of a market whose robots go out of service and are switched off: how long they wait, and who gets them.

Two robots offer for every demand. In each run a person orders three jobs at once three times: while both robots work,
while one declines, and while one is off; the robots take turns. It fails if a robot that declined or was off gets a
contract, if an order is lost, or if the 99th percentile of the wait for a contract is 3 s or more.
"""

from __future__ import annotations

import asyncio
import logging
import sys
import tempfile
import time
from collections import Counter
from contextlib import AsyncExitStack
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

ROOT: Final = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT))  # `peers` finds anvil

from common import arguments, installed_anvil, router, show  # noqa: E402
from mesh import Agent, Declined  # noqa: E402
from mesh.base.background import Background  # noqa: E402
from mesh.chain import Account  # noqa: E402
from mesh.dev.anvil import find_anvil, serve_anvil  # noqa: E402
from mesh.dev.demo import write_objective  # noqa: E402
from mesh.dev.development import deploy_market  # noqa: E402
from mesh.market.provider import provider_of  # noqa: E402
from mesh.network import Endpoints, Network  # noqa: E402
from mesh.role.composition import chain_of  # noqa: E402
from mesh.settings import Settings  # noqa: E402
from schemas import cid_of_bytes  # noqa: E402

if TYPE_CHECKING:
    from schemas import Demand, Verified

MODEL: Final = cid_of_bytes(b"what the robots of the benchmark can do")
AT_ONCE: Final = 3
LOST_AFTER: Final = 60.0
"""Seconds after which an order without a contract counts as lost."""
BOUND: Final = 3.0
"""Seconds that 99 of 100 orders may wait for their contract."""


class Robot:
    """A robot that offers for every demand while it is in service, and can be switched off and on."""

    def __init__(self, name: str, settings: Settings, account: Account) -> None:
        self._settings = replace(settings, data_dir=f"{settings.data_dir}/{name}")
        self._account = account
        self._stack = AsyncExitStack()
        self.address = account.address
        self.is_in_service = True

    async def switch_on(self) -> None:
        """Run an agent of the account."""
        agent = Agent(MODEL, settings=self._settings, account=self._account)

        @agent.on("*")
        async def nothing(job: object, message: object) -> None:
            pass

        @agent.on_demand
        async def weigh(demand: Verified[Demand]) -> None:
            if not self.is_in_service:
                raise Declined("out-of-service", "its arm is broken")
            await agent.offer(demand)

        await self._stack.enter_async_context(agent)

    async def switch_off(self) -> None:
        """End the agent, as Ctrl-C does."""
        await self._stack.aclose()


class Wave:
    """What became of the orders so far."""

    def __init__(self, person: Agent, objective: str) -> None:
        self._person, self._objective = person, objective
        self.waits: list[float] = []
        self.lost = 0
        self.wrong: Counter[str] = Counter()

    async def order(self, excluded: str, why: str, *, cost: int) -> None:
        """Order jobs at once, and wait until they are paid. No contract may be with `excluded` (an address)."""
        await asyncio.gather(*(self._order_one(excluded, why, cost) for _ in range(AT_ONCE)))

    async def _order_one(self, excluded: str, why: str, cost: int) -> None:
        began = time.monotonic()
        try:
            async with asyncio.timeout(LOST_AFTER):
                contract = await self._person.demand(self._objective, cost=cost)
                self.waits.append(time.monotonic() - began)
                self.wrong[why] += contract.liability.promisor == excluded
                self.lost += not (await contract.outcome()).success
        except TimeoutError:
            self.lost += 1


async def measure(settings: Settings, runs: int) -> dict[str, Any]:
    """Do the runs."""
    program = find_anvil(installed_anvil())
    assert program is not None, "`make peers` installs anvil"
    async with (
        serve_anvil(program, host="127.0.0.1", port=0, block_time=None, state=None) as node,
        AsyncExitStack() as stack,
    ):
        market = await deploy_market(node.url, node.funded_keys)
        settings = replace(
            settings,
            web3_http_provider=node.url,
            free_contracts=1_000_000,
            ens_contract=market.deployment.ens,
            lighthouse_contract=market.deployment.lighthouse_name,
        )
        enter, accounts = stack.enter_async_context, [Account(key) for key in node.funded_keys]
        own = replace(settings, data_dir=f"{settings.data_dir}/provider")
        chain = await enter(chain_of(own, market.accounts["provider"]))
        network = await enter(Network(Endpoints(connect=settings.connect)))
        provider = await enter(await provider_of(own, network.session, chain))
        tasks = await enter(Background())
        tasks.start(provider.run(), "provider")
        robots = [Robot(f"robot-{number}", settings, accounts[4 + number]) for number in range(2)]
        for robot in robots:
            await robot.switch_on()
            stack.push_async_callback(robot.switch_off)
        own = replace(settings, data_dir=f"{settings.data_dir}/person")
        person = await enter(Agent(MODEL, settings=own, account=market.accounts["person"]))
        path = Path(settings.data_dir) / "job.mcap"
        write_objective(path)
        waves = Wave(person, await person.add(path))
        await waves.order("", "prepare", cost=1)
        waves.waits.clear()
        for run in range(runs):
            one, other = robots[run % 2], robots[1 - run % 2]
            await waves.order("", "both work", cost=1)
            one.is_in_service = False
            await waves.order(one.address, "declined", cost=1)
            one.is_in_service = True
            await other.switch_off()
            await waves.order(other.address, "was off", cost=1)
            await other.switch_on()
    waits = sorted(waves.waits)
    return {
        "runs": runs,
        "orders": len(waits) + waves.lost,
        "lost": waves.lost,
        "contracts_with_a_robot_that_declined": waves.wrong["declined"],
        "contracts_with_a_robot_that_was_off": waves.wrong["was off"],
        "median_wait_s": round(waits[len(waits) // 2], 2),
        "p99_wait_s": round(waits[int(len(waits) * 0.99)], 2),
        "longest_wait_s": round(waits[-1], 2),
    }


def main() -> None:
    """Print the figures; exit with 1 if one is out of bounds."""
    given = arguments(str(__doc__), runs=200, generation=3)
    logging.getLogger("mesh").setLevel(logging.ERROR)
    with router() as (endpoint, _), tempfile.TemporaryDirectory() as folder:
        settings = Settings(connect=(endpoint,), data_dir=folder, playback="at-once", generation=given.generation)
        results = asyncio.run(measure(settings, given.runs))
    show(results, as_json=given.json)
    wrong = results["contracts_with_a_robot_that_declined"] + results["contracts_with_a_robot_that_was_off"]
    if wrong or results["lost"] or results["p99_wait_s"] >= BOUND:
        sys.exit(1)


if __name__ == "__main__":
    main()
