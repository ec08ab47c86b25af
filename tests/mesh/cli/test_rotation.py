"""`aira account rotate` is killed after each step and after each transaction, and completes when it is run again."""

from __future__ import annotations

import asyncio
import json
import sys
from typing import TYPE_CHECKING, Any, Final

import pytest

from mesh.agent.agent import Agent
from mesh.chain import Account, KeyfileError
from mesh.errors import ConfigurationError
from mesh.network import Endpoints, Network
from schemas import ProfileKey, cid_of_bytes
from schemas.address import shortened
from tests.mesh.cli.site import MODEL, QUICK_RESEND, Site
from tests.support.commands import aira, refused, run
from tests.support.development import ServedChain, serve_embedded
from tests.support.objectives import objective as recorded
from tests.support.raising import raises_with
from tests.support.waiting import until, until_answered

if TYPE_CHECKING:
    import subprocess
    from collections.abc import AsyncIterator
    from pathlib import Path

    from tests.support.routers import EmbeddedRouter

COST: Final = 1000
TIMEOUT: Final = 120.0
BEFORE_THE_END: Final = ("begun", "paused", "withdrawn")
AFTER_THE_END: Final = (
    "ended",
    "stake-withdrawn",
    "tokens-moved",
    "coin-moved",
    "handed-over",
    "staked",
    "retired",
    "exchanged",
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


@pytest.mark.full
async def test_a_provider_moves_with_its_stake(site: Site) -> None:
    old = site.address("provider")
    async with site.chain("provider") as chain:
        (stake,) = (await chain.lighthouses.get(site.lighthouse)).stakes.values()
        free, coin = await chain.tokens.balance(), await chain.tokens.eth_balance()
    async with site.provider():
        refused(await rotate(site, "provider"), "provider-running", old)
    times = 0
    while await killed(site, "provider", "sent"):
        times += 1
    assert times >= 4, "withdrawal of the stake, XRT, coin, approval, stake"
    new = keyfile_of(site, "provider")
    assert new.address != old
    async with site.chain("person") as chain:
        assert (await chain.lighthouses.get(site.lighthouse)).stakes == {new.address: stake}
        assert await chain.tokens.balance(old) == 0
        assert await chain.tokens.balance(new.address) == free
        left = await chain.tokens.eth_balance(old)
        assert left < coin / 1000
        assert await chain.tokens.eth_balance(new.address) > 0.99 * coin
    async with site.provider():
        pass
