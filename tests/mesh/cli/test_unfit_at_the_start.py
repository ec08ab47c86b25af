"""A program that can't start prints the error and a hint, one line each, and exits with 1 or 2."""

from __future__ import annotations

import asyncio
import re
import sys
from typing import TYPE_CHECKING, NamedTuple

import pytest

from mesh.chain import Node, new_private_key
from tests.support.cli.site import MODEL, Site
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
    """A market that all tests of this module share; they change only the accounts `poor` and `rival`."""
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


class Failure(NamedTuple):
    """What a program that can't start prints."""

    exit_code: int
    code: str
    text: str
    hint: str


def failure_of(program: tuple[str, ...], variables: dict[str, str]) -> Failure:
    """The failure of a program; stderr holds an error, a hint and nothing else but that nobody has the objective."""
    done: CompletedProcess[str] = run(*program, **variables)
    lines = [line for line in done.stderr.splitlines() if f"nobody here has the objective {MODEL}" not in line]
    assert len(lines) == 2, done.stderr
    error = re.fullmatch(r"aira: (?P<text>.*) \[(?P<code>[a-z-]+)\]", lines[0])
    assert error is not None, lines[0]
    assert lines[1].startswith("      ")
    return Failure(done.returncode, error["code"], error["text"], lines[1].strip())


@pytest.mark.sample("program")
@ALL
def test_a_wrong_password(site: Site, program: tuple[str, ...]) -> None:
    variables = site.variables("person")
    guess = site.folder / "guess"
    guess.write_text("guessed\n")
    failure = failure_of(program, variables | {"AIRA_KEYFILE_PASSWORD_FILE": str(guess)})
    assert (failure.exit_code, failure.code) == (2, "wrong-password")
    assert variables["AIRA_KEYFILE"] in failure.text
    assert str(guess) in failure.text
    assert "guessed" not in failure.text + failure.hint


@pytest.mark.sample("program")
@ALL
def test_a_node_that_does_not_answer(site: Site, program: tuple[str, ...]) -> None:
    nowhere = f"http://127.0.0.1:{free_port()}"
    failure = failure_of(program, site.variables("person", web3_http_provider=nowhere))
    assert (failure.exit_code, failure.code) == (1, "node-unreachable")
    assert nowhere in failure.text
    assert "web3_http_provider" in failure.hint


@pytest.mark.sample("program")
@ALL
def test_a_chain_without_the_contracts(site: Site, bare: Anvil, program: tuple[str, ...]) -> None:
    failure = failure_of(program, site.variables("person", web3_http_provider=bare.url))
    assert (failure.exit_code, failure.code) == (1, "no-contracts")
    assert "31337" in failure.text
    assert "web3_http_provider" in failure.hint


@pytest.mark.sample("program")
@ALL
def test_an_unknown_lighthouse(site: Site, program: tuple[str, ...]) -> None:
    name = "nowhere.lighthouse.3.robonomics.eth"
    failure = failure_of(program, site.variables("provider", lighthouse_contract=name))
    assert (failure.exit_code, failure.code) == (1, "unknown-name")
    assert name in failure.text


def test_a_provider_without_a_stake(site: Site) -> None:
    failure = failure_of(PROVIDER, site.variables("poor"))
    assert (failure.exit_code, failure.code) == (1, "no-stake")
    assert site.address("poor") in failure.text
    assert site.lighthouse in failure.text
    assert "`aira lighthouse join 1000000000wn`" in failure.hint


def test_a_provider_without_eth(site: Site) -> None:
    asyncio.run(stake_and_spend_all_eth(site, "rival"))
    failure = failure_of(PROVIDER, site.variables("rival"))
    assert (failure.exit_code, failure.code) == (1, "insufficient-funds")
    assert site.address("rival") in failure.text


def test_a_demand_that_can_not_be_paid(site: Site) -> None:
    failure = failure_of((*DEMAND, "--cost", "7"), site.variables("nobody"))
    assert failure.exit_code == 1, failure.text
    assert "7 XRT" in failure.text
