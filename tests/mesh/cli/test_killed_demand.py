"""`aira demand` is killed and run again: no demand is made and paid behind anyone's back."""

from __future__ import annotations

import asyncio
import json
import os
import signal
from typing import TYPE_CHECKING

import pytest

from tests.support.cli.site import MODEL, Site, has_event
from tests.support.commands import AIRA, Serving, aira, environment
from tests.support.waiting import until, until_found

if TYPE_CHECKING:
    from pathlib import Path

    from schemas import Demand, Liability, Verified
    from tests.support.nodes import Anvil
    from tests.support.routers import EmbeddedRouter

COST = 6000
TIMEOUT = 120.0


class Person:
    """A person at a command line, whose allowance covers what the commands approve and no more."""

    def __init__(self, site: Site) -> None:
        self.site = site

    def demand(self, *options: str, says: str = "posted") -> Serving:
        """`aira demand`, not yet started."""
        return Serving(*AIRA, *self.words(*options), says=says, variables=self.site.variables("person"))

    def words(self, *options: str) -> tuple[str, ...]:
        objective = str(self.site.job("work"))
        return ("demand", "--model", MODEL, "--objective", objective, "--cost", f"{COST}wn", *options)

    async def killed(self) -> str:
        """The hash of a demand whose command was killed after it was posted."""
        command = self.demand()
        await asyncio.to_thread(command.start)
        await asyncio.to_thread(command.end, signal.SIGKILL)
        return command.log().split("posted ")[1].split(",")[0]

    async def orders(self) -> list[tuple[str, str]]:
        """The hashes and states that `aira order list` prints."""
        listed = await asyncio.to_thread(aira, "order", "list", "--json", **self.site.variables("person"))
        assert listed.returncode == 0, listed.stderr
        return [(order["hash"], order["state"]) for order in json.loads(listed.stdout)]

    async def contracts(self) -> list[Liability]:
        async with self.site.chain("person") as chain:
            return list(await chain.liabilities.list(promisee=self.site.address("person")))

    async def ended(self, count: int) -> list[Liability]:
        """Wait for that many finalized contracts, and a while longer for one too many; all contracts."""

        async def reached() -> bool:
            return sum(contract.is_finalized for contract in await self.contracts()) >= count

        await until_found(reached, what=f"{count} finalized contracts", seconds=TIMEOUT)
        await asyncio.sleep(1.0)
        return await self.contracts()


@pytest.fixture
async def person(anvil: Anvil, router: EmbeddedRouter, tmp_path: Path) -> Person:
    site = await Site.found(anvil.url, anvil.private_keys, router.endpoint, tmp_path)
    async with site.chain("person") as chain:
        await chain.tokens.approve(chain.factory, 0)
    return Person(site)


@pytest.mark.full
async def test_run_again_without_a_terminal_it_says_what_can_be_chosen(person: Person) -> None:
    killed = await person.killed()
    again = await asyncio.to_thread(aira, *person.words(), **person.site.variables("person"))
    assert again.returncode == 2
    assert "[demand-exists]" in again.stderr
    assert killed in again.stderr
    assert all(f"--existing {choice}" in again.stderr for choice in ("wait", "withdraw", "new"))
    assert await person.orders() == [(killed, "open")]


@pytest.mark.full
async def test_run_again_it_can_wait_for_the_killed_demand(person: Person) -> None:
    killed = await person.killed()
    done: list[str] = []
    again = person.demand("--existing", "wait", says=killed)
    await asyncio.to_thread(again.start)
    async with person.site.provider(), person.site.robot(done):
        assert await asyncio.to_thread(again.wait) == 0
        (contract,) = await person.ended(1)
    assert (contract.is_success, contract.cost, done) == (True, COST, ["work"])
    assert f"contract {contract.address}" in again.log()


async def test_run_again_it_can_withdraw_the_killed_demand(person: Person) -> None:
    """The provider has the killed one, and would match it first."""
    done: list[str] = []
    async with person.site.provider() as provider:
        killed = await person.killed()
        again = person.demand("--existing", "withdraw")
        await asyncio.to_thread(again.start)
        assert killed not in again.log().split("posted ")[1]
        assert [state for _, state in await person.orders()] == ["open", "withdrawn"]
        await until(lambda: has_event(provider, "withdrawal-honoured", order=killed), seconds=TIMEOUT)
        async with person.site.robot(done):
            assert await asyncio.to_thread(again.wait) == 0
            (contract,) = await person.ended(1)
    assert (contract.is_success, done) == (True, ["work"])
    async with person.site.chain("person") as chain:
        demand_hash, _ = (await chain.liabilities.get_with_orders(contract.address))[1]
    assert demand_hash.hex() != killed


@pytest.mark.full
async def test_run_again_it_can_post_another_demand_and_pay_for_both(person: Person) -> None:
    killed = await person.killed()
    done: list[str] = []
    again = person.demand("--existing", "new")
    await asyncio.to_thread(again.start)
    assert [state for _, state in await person.orders()] == ["open", "open"]
    async with person.site.provider(), person.site.robot(done):
        assert await asyncio.to_thread(again.wait) == 0
        contracts = await person.ended(2)
    assert [contract.is_success for contract in contracts] == [True, True]
    assert done == ["work", "work"]
    async with person.site.chain("person") as chain:
        hashes = {(await chain.liabilities.get_with_orders(contract.address))[1][0].hex() for contract in contracts}
    assert killed in hashes


@pytest.mark.full
async def test_run_again_it_can_wait_for_the_contract_of_the_killed_demand(person: Person) -> None:
    """It was killed after the match: a second demand would pay for the work twice."""
    may_work = asyncio.Event()
    robot = person.site.agent("robot")

    @robot.on_demand
    async def offer(demand: Verified[Demand]) -> None:
        await robot.offer(demand)

    @robot.on("/say")
    async def say(job: object, message: object) -> None:
        await may_work.wait()

    first = person.demand(says="contract 0x")
    async with person.site.provider(), robot:
        await asyncio.to_thread(first.start)
        await asyncio.to_thread(first.end, signal.SIGKILL)
        (contract,) = await person.contracts()
        refused = await asyncio.to_thread(aira, *person.words(), **person.site.variables("person"))
        assert refused.returncode == 2
        assert contract.address in refused.stderr
        again = person.demand("--existing", "wait", says=f"contract {contract.address}")
        await asyncio.to_thread(again.start)
        may_work.set()
        assert await asyncio.to_thread(again.wait) == 0
        assert [one.is_success for one in await person.ended(1)] == [True]


async def test_run_again_in_a_terminal_it_asks(person: Person) -> None:
    killed = await person.killed()
    terminal, inside = os.openpty()
    command = await asyncio.create_subprocess_exec(
        *AIRA, *person.words(), stdin=inside, stdout=inside, stderr=inside,
        env=environment(person.site.variables("person")),
    )  # fmt: skip
    os.close(inside)
    said = b""
    while b"what now?" not in said:
        said += await asyncio.to_thread(os.read, terminal, 4096)
    assert killed.encode() in said
    assert all(choice in said for choice in (b"wait: ", b"withdraw: ", b"new: "))
    os.write(terminal, b"withdraw\n")
    while b"posted " not in said:
        said += await asyncio.to_thread(os.read, terminal, 4096)
    assert f"withdrew {killed}".encode() in said
    command.send_signal(signal.SIGINT)
    assert await asyncio.wait_for(command.wait(), TIMEOUT) == 130
    os.close(terminal)


@pytest.mark.full
async def test_an_interrupted_demand_stays_open_until_it_is_withdrawn(person: Person) -> None:
    command = person.demand()
    await asyncio.to_thread(command.start)
    code, _ = await asyncio.to_thread(command.end, signal.SIGINT)
    identity = command.log().split("posted ")[1].split(",")[0]
    assert code == 130
    assert f"aira order withdraw {identity[:16]}" in command.log()
    assert await person.orders() == [(identity, "open")]
    words = ("order", "withdraw", identity[:16], "--on-chain", "--json")
    withdrawn = await asyncio.to_thread(aira, *words, **person.site.variables("person"))
    assert withdrawn.returncode == 0, withdrawn.stderr
    (fact,) = json.loads(withdrawn.stdout)
    assert (fact["hash"], fact["providers"], fact["confirmedBy"]) == (identity, 0, 0)
    assert fact["tx"]
    assert await person.orders() == []
    async with person.site.chain("person") as chain:
        assert await chain.liabilities.is_order_used(bytes.fromhex(identity), person.site.address("person"))
