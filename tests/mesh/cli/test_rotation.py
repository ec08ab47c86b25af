"""`aira account rotate` is killed after each step and after each transaction, and completes when it is run again."""

from __future__ import annotations

import asyncio
import json
import sys
from contextlib import AsyncExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import pytest

from mesh.agent.agent import Agent
from mesh.chain import XRT, Account, KeyfileError, keyfile_address
from mesh.errors import ConfigurationError
from mesh.network import Endpoints, Network
from schemas import ProfileKey, cid_of_bytes
from schemas.address import shortened
from tests.support.cli.site import MODEL, QUICK_RESEND, Site
from tests.support.commands import aira, refused, run
from tests.support.development import ServedChain, serve_embedded
from tests.support.objectives import objective as recorded
from tests.support.raising import raises_with
from tests.support.waiting import until, until_answered, until_found

if TYPE_CHECKING:
    import subprocess
    from collections.abc import AsyncIterator

    from tests.support.routers import EmbeddedRouter

COST: Final = 1000
TIMEOUT: Final = 120.0
TIMEOUT_BLOCKS: Final = 6
BEFORE_THE_END: Final = ("begun", "paused", "withdrawn")
AFTER_THE_END: Final = (
    "ended",
    "handed-over",
    "retired",
    "exchanged",
    "stake-withdrawn",
    "tokens-moved",
    "coin-moved",
    "staked",
)
"""The steps of a rotation, before and after the end of the contracts."""
KILLED: Final = """
import os, signal, sys
from mesh.chain._node import Node
from mesh.ops import rotation

at, sent, send = sys.argv.pop(1), 0, Node.send_raw

def die():
    os.kill(os.getpid(), signal.SIGKILL)

async def send_and_die(self, raw):
    global sent
    sent += 1
    await send(self, raw)
    if at == "sent":
        die()

rotation.reached = lambda step: die() if step == at else None
Node.send_raw = send_and_die
from mesh.__main__ import main
main()
"""
"""`aira` that is killed when a step of a rotation is complete, or, at `sent`, when it has sent a transaction."""


@pytest.fixture
async def served() -> AsyncIterator[ServedChain]:
    """A chain of this test's own, which makes a block for each transaction."""
    async with serve_embedded() as running:
        yield running


@pytest.fixture
async def site(served: ServedChain, router: EmbeddedRouter, tmp_path: Path) -> Site:
    return await Site.found(served.url, served.node.funded_keys, router.endpoint, tmp_path)


async def rotate(site: Site, role: str, *options: str) -> subprocess.CompletedProcess[str]:
    return await asyncio.to_thread(aira, "account", "rotate", "--json", *options, **site.variables(role))


async def killed(site: Site, role: str, at: str) -> bool:
    """Begin or go on with a rotation that is killed; whether it was, and did not end before."""
    words = (sys.executable, "-c", KILLED, at, "account", "rotate", "--json")
    done = await asyncio.to_thread(run, *words, **site.variables(role))
    assert done.returncode in (-9, 0), done.stderr
    return done.returncode == -9


def keyfile_of(site: Site, role: str) -> Account:
    variables = site.variables(role)
    return Account.from_keyfile(variables["AIRA_KEYFILE"], variables["AIRA_KEYFILE_PASSWORD_FILE"])


async def holdings(site: Site, address: str) -> tuple[int, int]:
    """XRT (wn) and coin (wei) of an address."""
    async with site.chain("person") as chain:
        return await chain.tokens.balance(address), await chain.tokens.eth_balance(address)


@pytest.mark.full
async def test_a_robot_with_a_running_job_and_an_open_offer_moves(site: Site, tmp_path: Path) -> None:
    began, may_end = asyncio.Event(), asyncio.Event()
    old = site.address("robot")
    robot = site.robot([], name="Lift 1", least_price="1wn")

    @robot.on("/wait")
    async def wait(job: object, message: Any) -> None:
        began.set()
        await may_end.wait()

    objective = tmp_path / "wait.mcap"
    objective.write_bytes(recorded(("/wait", "go")))
    async with (
        asyncio.timeout(5 * TIMEOUT),
        site.provider() as _,
        robot,
        site.agent("person") as person,
    ):
        contract = await person.demand(objective, cost=COST)
        await until(began.is_set, what="the job's begin", seconds=TIMEOUT)
        offer = await robot.offer(objective=cid_of_bytes(b"nobody wants this"), cost=5)
        planned = await rotate(site, "robot", "--dry-run")
        assert planned.returncode == 0, planned.stderr
        plan = json.loads(planned.stdout)
        assert (plan["old"], plan["orders"], plan["contracts"], plan["stake"]) == (old, 1, 1, "0")
        before = await holdings(site, old)
        for step in BEFORE_THE_END:
            assert await killed(site, "robot", step), step
        refused(await rotate(site, "robot", "--timeout", "1"), "contracts-open", contract.address, exit_code=1)
        assert robot.runtime.rules.closed() is not None, "it takes no new jobs"
        may_end.set()
        outcome = await contract.outcome()
        assert outcome.success
        recording = outcome.result
        for step in AFTER_THE_END:
            assert await killed(site, "robot", step), step
        done = json.loads((await rotate(site, "robot")).stdout)
    new = keyfile_of(site, "robot")
    assert (done["old"], done["new"]) == (old, new.address)
    assert new.address != old

    async with site.chain("person") as chain:
        assert await chain.liabilities.is_order_used(bytes.fromhex(offer), old), "nobody can use the offer"
    assert await holdings(site, old) == (0, int(done["left"]))
    xrt, coin = await holdings(site, new.address)
    assert xrt == before[0] + COST, "all of it, once"
    assert 0.99 * before[1] < coin + int(done["left"]) < before[1]

    await the_old_key_is_refused(site, done["retired"], old, new.address)
    moved = Agent(MODEL, settings=site.settings("robot", name="Lift 1"), account=new, resend=QUICK_RESEND)
    moved.on_demand(lambda demand: None)
    async with moved, site.agent("person") as person, Network(Endpoints(connect=(site.endpoint,))) as network:
        await until_answered(network.session, str(ProfileKey(new.address)))
        (seen,) = await person.robots()
        assert (seen.name, seen.address, seen.formerly) == ("Lift 1", new.address, (old,))
        assert (seen.paid, seen.refunded) == (1, 0), "the record of the old key counts"
        listed = await asyncio.to_thread(aira, "robots", **site.variables("person"))
        assert f"1 paid, 0 refunded, formerly {shortened(old)}" in listed.stdout
        assert moved.parts.store.has(recording), "others may still fetch it"
        assert moved.runtime.rules.closed() is None, "it takes jobs again"


async def the_old_key_is_refused(site: Site, retired: str, old: str, new: str) -> None:
    """By its keyfile, and by the data folder where somebody puts a copy back."""
    variables = site.variables("robot")
    with raises_with(KeyfileError, code="keyfile-retired"):
        Account.from_keyfile(retired, variables["AIRA_KEYFILE_PASSWORD_FILE"])
    command = await asyncio.to_thread(aira, "order", "withdraw", "--all", "--keyfile", retired, **variables)
    refused(command, "keyfile-retired", new)
    with raises_with(ConfigurationError, code="key-retired"):
        async with site.agent("robot"):
            pass


async def test_a_robot_that_its_owner_has_paused_stays_paused(site: Site) -> None:
    async with site.robot([]) as robot:
        await robot.control(paused=True)
    done = await rotate(site, "robot")
    assert done.returncode == 0, done.stderr
    async with Agent(MODEL, settings=site.settings("robot"), account=keyfile_of(site, "robot")) as moved:
        assert moved.runtime.rules.closed() is not None, "it takes no jobs"


@pytest.mark.full
async def test_a_provider_without_xrt_for_two_stakes_is_stopped_and_moves_with_its_stake(site: Site) -> None:
    await site.found_lighthouse("own", timeout_blocks=TIMEOUT_BLOCKS, provider=1)
    await spend_all(site)
    old = site.address("provider")
    async with site.chain("provider") as chain:
        coin = await chain.tokens.eth_balance()
        before = await chain.block_number()
        async with site.provider():
            hint = refused(await rotate(site, "provider"), "provider-running", old, "1 XRT are missing")
        assert await chain.block_number() == before, "nothing was sent"
    assert "five transactions" in hint
    planned = await rotate(site, "provider", "--dry-run")
    assert json.loads(planned.stdout)["missing"] == str(XRT)
    times = 0
    while await killed(site, "provider", "sent"):
        times += 1
    assert times >= 4, "withdrawal of the stake, XRT, coin, approval, stake"
    new = keyfile_of(site, "provider")
    assert new.address != old
    await the_money_has_moved(site, old, new.address, stake=XRT, coin=coin)
    async with site.provider():
        pass


@pytest.mark.full
@pytest.mark.sample("stake")
@pytest.mark.parametrize("stake", [1, 2])
async def test_a_lighthouse_has_a_provider_at_work_in_each_block(site: Site, stake: int) -> None:
    await site.found_lighthouse("own", timeout_blocks=TIMEOUT_BLOCKS, provider=stake)
    if stake > 1:  # otherwise the second stake is free
        await spend_all(site)
    done: list[str] = []
    old, coin = site.address("provider"), (await holdings(site, site.address("provider")))[1]
    keyfile = Path(site.variables("provider")["AIRA_KEYFILE"])
    async with (
        asyncio.timeout(5 * TIMEOUT),
        site.chain("person") as chain,
        site.provider() as first,
        site.robot(done),
        site.agent("person") as person,
        AsyncExitStack() as stack,
    ):

        async def has_left() -> bool:
            return old not in (await chain.lighthouses.get(site.lighthouse)).stakes

        async def job(word: str) -> None:
            contract = await person.demand(await asyncio.to_thread(site.job, word), cost=COST)
            assert (await contract.outcome()).success

        async def operate() -> tuple[int, int]:
            """Start the second provider when it has the new key, stop the first when it has no stake any more.

            Returns when the second had begun and when the first still worked, block numbers.
            """
            await until(lambda: keyfile_address(keyfile) != old, what="the new keyfile", seconds=TIMEOUT)
            await job("of the first")
            await stack.enter_async_context(site.provider())
            begun = await chain.block_number()
            await until_found(has_left, what="the withdrawal of the old stake", seconds=TIMEOUT)
            await job("of the second")
            ended = await chain.block_number()
            await asyncio.to_thread(first.stop)
            return begun, ended

        start = await chain.block_number()
        operator = asyncio.create_task(operate())
        times = 0
        while await killed(site, "provider", "sent"):
            times += 1
        begun, ended = await operator
        end = await chain.block_number()
        assert times >= 7, "coin, XRT, approval and stake ahead, withdrawal, XRT, coin"
        new = keyfile_of(site, "provider").address
        await job("after it")
        lighthouse = chain.node.contract("Lighthouse", await chain.names.lighthouse(site.lighthouse))
        at_work = {old: range(start, ended + 1), new: range(begun, end + 1)}
        for block in range(start, end + 1):
            stakes = {one: await chain.node.read(lighthouse.stakes(one), block=block) for one in at_work}
            assert any(stakes[one] and block in blocks for one, blocks in at_work.items()), (block, stakes, at_work)
    assert done == ["of the first", "of the second", "after it"], "each once"
    await the_money_has_moved(site, old, new, stake=stake * XRT, coin=coin)


async def spend_all(site: Site) -> None:
    """Leave the provider no XRT but its stakes."""
    async with site.chain("provider") as chain:
        await chain.tokens.transfer(site.address("person"), await chain.tokens.balance())


async def the_money_has_moved(site: Site, old: str, new: str, *, stake: int, coin: int) -> None:
    """All XRT, the stake, and the coin but for the price of transactions."""
    async with site.chain("person") as chain:
        assert (await chain.lighthouses.get(site.lighthouse)).stakes == {new: stake}
    xrt, left = await holdings(site, old)
    assert (xrt, left < coin / 1000) == (0, True)
    assert (await holdings(site, new))[1] > 0.99 * coin
