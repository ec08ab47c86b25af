"""Programs that can't begin say why in one line, and what to do in another, and end with an error's exit code."""

from __future__ import annotations

import asyncio
import sys
from typing import TYPE_CHECKING

import pytest

from mesh.chain import Node, new_private_key
from tests.mesh.operations.site import MODEL, Site
from tests.support.commands import AIRA, run
from tests.support.nodes import Anvil
from tests.support.ports import free_port
from tests.support.routers import EmbeddedRouter

if TYPE_CHECKING:
    from collections.abc import Iterator
    from subprocess import CompletedProcess

AGENT = (sys.executable, "-c", "from mesh import Agent; Agent().run()")
PROVIDER = (*AIRA, "provider")
DEMAND = (*AIRA, "demand", "--model", MODEL, "--objective", MODEL)
ALL = pytest.mark.parametrize("program", [PROVIDER, DEMAND, AGENT], ids=["provider", "demand", "agent"])


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Site]:
    """A market that all tests of this module share; they only ask, and change nothing but `poor`, `rival`, `empty`."""
    with Anvil() as node, EmbeddedRouter() as router:
        folder = tmp_path_factory.mktemp("site")
        site = asyncio.run(Site.found(node.url, node.private_keys, router.endpoint, folder))
        site.keys["nobody"] = new_private_key()
        yield site


@pytest.fixture(scope="module")
def bare() -> Iterator[Anvil]:
    """A chain with nothing on it."""
    with Anvil() as node:
        yield node


async def have_eth(site: Site, role: str, wei: int) -> None:
    async with Node(site.url) as node:
        await node.request("anvil_setBalance", site.address(role), hex(wei))


async def stake_and_spend_all_eth(site: Site, role: str) -> None:
    async with site.chain("provider") as chain:
        await chain.tokens.transfer(site.address(role), 10**9)
    async with site.chain(role) as chain:
        await chain.lighthouses.become_provider(site.lighthouse, 10**9)
    await have_eth(site, role, 0)


def refused(program: tuple[str, ...], variables: dict[str, str]) -> tuple[int, str, str]:
    """Exit code, the line that says why, and the hint; there is nothing else."""
    done: CompletedProcess[str] = run(*program, **variables)
    lines = done.stderr.splitlines()
    assert len(lines) == 2, done.stderr
    assert lines[0].startswith("aira: ")
    assert lines[1].startswith("      ")
    return done.returncode, lines[0].removeprefix("aira: "), lines[1].strip()


@ALL
def test_a_wrong_password(site: Site, program: tuple[str, ...]) -> None:
    variables = site.variables("person")
    guess = site.folder / "guess"
    guess.write_text("guessed\n")
    code, why, hint = refused(program, variables | {"AIRA_KEYFILE_PASSWORD_FILE": str(guess)})
    assert (code, why) == (2, f"{variables['AIRA_KEYFILE']}: the password in {guess} does not open it")
    assert "one line with the password" in hint
    assert "guessed" not in why + hint


@ALL
def test_a_node_that_is_not_there(site: Site, program: tuple[str, ...]) -> None:
    nowhere = f"http://127.0.0.1:{free_port()}"
    code, why, hint = refused(program, site.variables("person", web3_http_provider=nowhere))
    assert (code, why.startswith(f"no Ethereum node answers at {nowhere} (")) == (1, True)
    assert "web3_http_provider" in hint


@ALL
def test_a_chain_without_the_contracts(site: Site, bare: Anvil, program: tuple[str, ...]) -> None:
    code, why, hint = refused(program, site.variables("person", web3_http_provider=bare.url))
    assert (code, why.startswith("the chain 31337 has no ")) == (1, True), why
    assert "web3_http_provider" in hint


@ALL
def test_a_lighthouse_that_nobody_knows(site: Site, program: tuple[str, ...]) -> None:
    name = "nowhere.lighthouse.3.robonomics.eth"
    code, why, hint = refused(program, site.variables("provider", lighthouse_contract=name))
    assert (code, why) == (1, f"the ENS name '{name}' is not known on this chain")
    assert "spelling" in hint


def test_a_provider_without_a_stake(site: Site) -> None:
    code, why, hint = refused(PROVIDER, site.variables("poor"))
    assert (code, why) == (1, f"{site.address('poor')} has no stake at the lighthouse {site.lighthouse}")
    assert hint == "stake 1000000000 wn or more: `aira lighthouse join 1000000000wn`"


def test_a_provider_without_eth(site: Site) -> None:
    asyncio.run(stake_and_spend_all_eth(site, "rival"))
    code, why, hint = refused(PROVIDER, site.variables("rival"))
    assert (code, why.startswith(f"{site.address('rival')} has 0 ETH, and the transaction may need ")) == (1, True)
    assert hint == "send ETH to the account; gas is paid in it"


def test_a_demand_that_can_not_be_paid(site: Site) -> None:
    code, why, hint = refused((*DEMAND, "--cost", "7"), site.variables("nobody"))
    assert (code, why.endswith(" has 0 XRT, and 7 XRT are needed")) == (1, True), why
    assert hint.startswith("send it what is missing")


def test_a_demand_without_eth_for_the_allowance(site: Site) -> None:
    asyncio.run(have_xrt_only(site, "poor"))
    code, why, hint = refused((*DEMAND, "--cost", "7wn"), site.variables("poor"))
    assert (code, why.startswith(f"{site.address('poor')} has 0 ETH, and the transaction may need ")) == (1, True), why
    assert hint == "send ETH to the account; gas is paid in it"


async def have_xrt_only(site: Site, role: str) -> None:
    async with site.chain("provider") as chain:
        await chain.tokens.transfer(site.address(role), 7)
    await have_eth(site, role, 0)
