"""Two providers of one lighthouse share its work by their stakes. After one is killed, the other does the rest."""

from __future__ import annotations

import asyncio
from collections import Counter
from typing import TYPE_CHECKING, Any, NamedTuple

import pytest

from mesh.base.background import Background
from schemas import parse_address
from tests.support.cli.site import FEE, Site
from tests.support.development import ServedChain, serve_embedded
from tests.support.waiting import until

if TYPE_CHECKING:
    from collections.abc import AsyncIterator
    from pathlib import Path

    from mesh.agent.agent import Agent
    from mesh.agent.contracts import Outcome
    from mesh.chain import Chain
    from tests.support.routers import EmbeddedRouter

JOBS = 16
COST = 1000
QUOTAS = {"provider": 2, "rival": 1}
TIMEOUT_BLOCKS = 6
TIMEOUT = 120.0


class Sent(NamedTuple):
    """A transaction to the lighthouse."""

    block: int
    role: str
    went_through: bool


@pytest.fixture
async def served() -> AsyncIterator[ServedChain]:
    """A chain of this test's own, which makes a block for each transaction."""
    async with serve_embedded() as running:
        yield running


@pytest.fixture
async def site(served: ServedChain, router: EmbeddedRouter, tmp_path: Path) -> Site:
    site = await Site.found(served.url, served.node.funded_keys, router.endpoint, tmp_path)
    await site.found_lighthouse("shared", timeout_blocks=TIMEOUT_BLOCKS, **QUOTAS)
    return site


@pytest.mark.full
async def test_providers_share_jobs_and_take_over_and_each_job_is_done_once(served: ServedChain, site: Site) -> None:
    done: list[str] = []
    async with site.chain("person") as chain, asyncio.timeout(2 * TIMEOUT):
        start, before = await chain.block_number(), await wealth(site, chain)
        provider, rival = site.provider("provider"), site.provider("rival")
        async with provider, rival, site.robot(done), site.agent("person") as person, Background() as tasks:
            jobs = [asyncio.create_task(one_job(site, person, number)) for number in range(JOBS)]
            await until(lambda: len(done) >= JOBS // 2, what="half of the jobs", seconds=TIMEOUT)
            shared = await sent(site, chain, start)
            await asyncio.to_thread(rival.kill)
            for _ in range(3):  # after what the chain's server had received from it, but not handled yet
                await served.node.mine()
            killed = await chain.block_number()
            tasks.start(mine_empty_blocks(served), "blocks without transactions")
            outcomes = await asyncio.gather(*jobs)
            log = await asyncio.to_thread(stopped, provider)
        made = await chain.liabilities.list(from_block=start)
        hashes = [(await chain.liabilities.get_with_orders(liability.address))[1] for liability in made]
        after, supply = await wealth(site, chain), await chain.tokens.supply()
        transactions = await sent(site, chain, start)

    assert all(outcome.success for outcome in outcomes)
    assert sorted(done) == sorted(word(number) for number in range(JOBS)), "each once"
    assert [(liability.is_finalized, liability.is_success) for liability in made] == [(True, True)] * JOBS
    assert len({digest for pair in hashes for digest in pair}) == 2 * JOBS

    assert_in_turns(shared)
    assert {one.role for one in transactions if one.block > killed} == {"provider"}
    assert Counter(one.went_through for one in transactions) == {True: 2 * JOBS}, "the providers did not race"

    assert after["person"] == before["person"] - JOBS * COST
    assert after["robot"] == before["robot"] + JOBS * (COST - FEE)
    assert after["factory"] == before["factory"] == 0
    assert after["provider"] + after["rival"] > before["provider"] + before["rival"] + JOBS * FEE
    assert sum(after.values()) == supply, "no XRT is lost or created out of nothing"
    assert "contracts: " in log
    assert "Traceback" not in log


def word(number: int) -> str:
    return f"job{number}"


async def one_job(site: Site, person: Agent, number: int) -> Outcome:
    path = await asyncio.to_thread(site.job, word(number))
    return await (await person.demand(path, cost=COST)).outcome()


async def mine_empty_blocks(served: ServedChain) -> None:
    while True:
        await served.node.mine()
        await asyncio.sleep(0.03)


def stopped(provider: Any) -> str:
    """The log of a provider after it was stopped."""
    provider.stop()
    return str(provider.log())


async def sent(site: Site, chain: Chain, start: int) -> list[Sent]:
    """The transactions to the lighthouse since a block, in order."""
    lighthouse = await chain.names.lighthouse(site.lighthouse)
    roles = {site.address(role): role for role in QUOTAS}
    found = []
    for number in range(start + 1, await chain.block_number() + 1):
        block = await chain.node.request("eth_getBlockByNumber", hex(number), True)
        for transaction in block["transactions"]:
            if transaction["to"] and parse_address(transaction["to"]) == lighthouse:
                receipt = await chain.node.receipt(transaction["hash"])
                assert receipt is not None
                found.append(Sent(number, roles[parse_address(transaction["from"])], receipt.status == 1))
    return found


def assert_in_turns(transactions: list[Sent]) -> None:
    """Without pauses: two transactions of the one with two stakes, one of the other, and so on."""
    pattern = [role for role, quota in QUOTAS.items() for _ in range(quota)]
    expected = [pattern[place % len(pattern)] for place in range(len(transactions))]
    assert [one.role for one in transactions] == expected
    assert len(transactions) > 2 * len(pattern)


async def wealth(site: Site, chain: Chain) -> dict[str, int]:
    """The XRT of each account."""
    holders = {role: account.address for role, account in site.accounts.items()}
    for name in ("airalab", site.lighthouse):
        holders[name] = await chain.names.lighthouse(name)
    return {
        name: await chain.tokens.balance(address) for name, address in (holders | {"factory": chain.factory}).items()
    }
