"""The chain, its clock, its contracts, and the account on it: sound ones, and each thing that can be wrong."""

from __future__ import annotations

import json
import time
import urllib.request
from typing import TYPE_CHECKING, Any

import pytest

from mesh.chain import XRT, Account, Chain, DeploymentPlan, deploy, new_private_key, write_keyfile
from mesh.doctor import Case, Verdict
from mesh.doctor.chain import stands_still
from mesh.settings import Settings
from tests.mesh.cli.chains import PASSWORD, TIMING, Town, write_quick_keyfile
from tests.mesh.doctor.examining import Found, examined
from tests.support.nodes import Anvil
from tests.support.ports import free_port

if TYPE_CHECKING:
    from pathlib import Path

    from mesh.doctor.case import Role
    from tests.support.routers import EmbeddedRouter

LIGHTHOUSE = "airalab.lighthouse.3.robonomics.eth"


class Ward:
    """Where the town's people are examined: with a router, and folders of their own."""

    def __init__(self, town: Town, endpoint: str, folder: Path) -> None:
        self.town = town
        self.endpoint = endpoint
        self.folder = folder

    def settings(self, who: str = "", **options: Any) -> Settings:
        named: dict[str, Any] = {
            "connect": (self.endpoint,),
            "web3_http_provider": self.town.url,
            "data_dir": str(self.folder),
        }
        if who:
            (self.folder / "password").write_text(PASSWORD + "\n")
            (self.folder / "password").chmod(0o600)
            named |= {
                "keyfile": str(self.town.people[who].keyfile),
                "keyfile_password_file": str(self.folder / "password"),
            }
        return Settings(**(named | options))

    async def examined(self, role: Role | None, who: str = "", *, chain_id: int = 0, **options: Any) -> Found:
        return await examined(Case(settings=self.settings(who, **options), asked_role=role, chain_id=chain_id))


@pytest.fixture
def ward(town: Town, router: EmbeddedRouter, tmp_path: Path) -> Ward:
    return Ward(town, router.endpoint, tmp_path)


async def test_an_agent_with_an_account_is_sound(ward: Ward) -> None:
    found = await ward.examined("agent", "robot")

    assert found.failed == []
    assert {finding.verdict for findings in found.values() for finding in findings} == {Verdict.OK}
    assert f"{ward.town.url} answers: chain " in found.one("node").found
    assert found.one("contracts").found.startswith("this project's: factory ")
    assert found.one("lighthouse").found.endswith("with 1 provider")
    assert ward.town.people["robot"].address in found.one("keyfile").found
    assert "1,000 XRT" in found.one("tokens").found


async def test_a_provider_with_a_stake_is_sound_and_told_whose_turn_it_is(ward: Ward) -> None:
    found = await ward.examined("provider", "provider")

    assert found.failed == []
    assert "100 XRT at airalab.lighthouse.3.robonomics.eth: 100 transactions a turn" in found.one("stake").found
    assert found.one("turn").found.startswith("its own, ")


async def test_who_only_looks_on_needs_no_account_and_who_is_to_be_an_agent_does(ward: Ward) -> None:
    looking = await ward.examined(None)
    asked = await ward.examined("agent")

    assert looking.failed == []
    assert "keyfile" not in looking
    assert "`aira account new`" in asked.cause("keyfile")


async def test_a_node_that_is_not_there_is_named_once(ward: Ward) -> None:
    url = f"http://127.0.0.1:{free_port()}"
    found = await ward.examined("agent", "robot", web3_http_provider=url)

    cause = found.cause("node")
    assert url in cause
    assert "aira chain up" in cause
    assert found.one("keyfile").ok
    assert found.one("data folder").ok


async def test_a_chain_that_is_not_the_expected_one_is_named_by_both_numbers(ward: Ward) -> None:
    found = await ward.examined("agent", chain_id=1)

    cause = "; ".join(finding.found for finding in found["chain"])
    assert cause.endswith(", and it should be 1")
    assert "chain" in found.failed
    assert "contracts" not in found


async def test_nodes_of_different_chains_are_told_apart(ward: Ward, anvil: Anvil) -> None:
    found = await ward.examined("bridge", web3_http_provider=f"{ward.town.url}, {anvil.url}")

    assert [finding.ok for finding in found["node"]] == [True, True]
    assert "is on the chain 31337, the others" in found.one("chain").found
    assert not found.one("chain").ok


async def test_a_chain_without_the_contracts_is_named_and_what_else_is_wrong_is_not_blamed(
    ward: Ward, anvil: Anvil
) -> None:
    found = await ward.examined("agent", "robot", web3_http_provider=anvil.url)

    cause = found.cause("contracts")
    assert "the chain 31337 has no ENS registry" in cause
    assert "aira chain deploy" in cause
    assert found.one("chain").ok
    assert "lighthouse" not in found


async def test_names_that_the_registry_does_not_know_are_named(ward: Ward) -> None:
    factory = await ward.examined("agent", "robot", factory_contract="factory.7.robonomics.eth")
    market = await ward.examined("agent", "robot", lighthouse_contract="nowhere.lighthouse.3.robonomics.eth")
    token = await ward.examined("agent", "robot", erc20_token="gold.3.robonomics.eth")

    assert "factory.7.robonomics.eth" in factory.cause("contracts")
    assert "nowhere.lighthouse.3.robonomics.eth" in market.cause("lighthouse")
    assert not token.one("token").ok
    assert "gold.3.robonomics.eth" in token.one("token").found


async def test_an_address_that_is_no_lighthouse_of_the_factory_is_named(ward: Ward) -> None:
    found = await ward.examined("agent", "robot", lighthouse_contract=ward.town.deployment.xrt)

    assert "is no lighthouse of this factory" in found.cause("lighthouse")


async def test_contracts_taken_for_the_original_ones_are_told_from_these(ward: Ward) -> None:
    found = await ward.examined("agent", contracts="original")

    assert "not the original contracts, but this project's" in found.one("contracts").found
    assert found.one("contracts").do == "--contracts mesh"


async def test_a_websocket_that_was_named_has_to_answer(ward: Ward) -> None:
    dead = f"ws://127.0.0.1:{free_port()}"
    alive = ward.town.url.replace("http", "ws")

    assert dead in (await ward.examined(None, web3_ws_provider=dead)).cause("websocket")
    assert (await ward.examined(None, web3_ws_provider=alive)).one("websocket").ok


async def test_what_is_no_address_of_a_node_is_a_finding(ward: Ward) -> None:
    assert "is not the address of a node" in (await ward.examined(None, web3_http_provider="8545")).cause("node")


@pytest.mark.parametrize(
    ("client", "age", "still"),
    [
        ("Geth/v1.15", 3_600, True),
        ("Geth/v1.15", 30, False),
        ("anvil/v1.7.1", 3_600, False),
        ("aira-embedded", 9e9, False),
    ],
)
def test_a_chain_stands_still_without_a_new_block_unless_it_is_one_for_development(
    client: str, age: float, still: bool
) -> None:
    assert stands_still(client, number=7, age=age) is still
    assert not stands_still(client, number=0, age=age)


async def test_an_old_block_of_a_development_chain_says_nothing_about_the_clock(ward: Ward) -> None:
    with Anvil(arguments=("--timestamp", str(int(time.time()) - 86_400))) as old:
        ask(old, "evm_setNextBlockTimestamp", int(time.time()) - 7_300)
        ask(old, "anvil_mine", "0x1")
        found = await ward.examined(None, web3_http_provider=old.url)

    assert found.one("node").ok
    assert found.one("chain clock").found == "the newest block is 2 hours old, and says nothing about the clock"


async def test_a_clock_behind_the_chain_s_is_named(ward: Ward, anvil: Anvil) -> None:
    ask(anvil, "evm_setNextBlockTimestamp", int(time.time()) + 3_600)
    ask(anvil, "anvil_mine", "0x1")

    found = await ward.examined(None, web3_http_provider=anvil.url)

    finding = found.one("chain clock")
    assert not finding.ok
    assert "60 minutes behind the chain's" in finding.found
    assert "set the clock" in finding.do


async def test_a_wrong_password_is_named_and_not_shown(ward: Ward) -> None:
    settings = ward.settings("robot")
    (ward.folder / "password").write_text("open barley\n")

    found = await examined(Case(settings=settings, asked_role="agent"))

    cause = found.cause("keyfile")
    assert "the password in" in cause
    assert "does not open it" in cause
    assert "barley" not in cause
    assert "ether" not in found


async def test_a_keyfile_that_others_may_read_is_a_warning(ward: Ward) -> None:
    settings = ward.settings("robot")
    (ward.folder / "password").chmod(0o644)

    finding = (await examined(Case(settings=settings, asked_role="agent"))).one("keyfile")

    assert finding.verdict is Verdict.WARN
    assert finding.do == f"chmod 600 {ward.folder / 'password'}"


async def test_a_keyfile_that_is_not_there_is_named(ward: Ward) -> None:
    settings = ward.settings("robot", keyfile=str(ward.folder / "lost.json"))

    assert "lost.json" in (await examined(Case(settings=settings, asked_role="agent"))).cause("keyfile")


def poor(ward: Ward) -> dict[str, Any]:
    """The settings of an account that has nothing."""
    keyfile = write_quick_keyfile(ward.folder / "poor.json", new_private_key())
    keyfile.chmod(0o600)
    return {"keyfile": str(keyfile)}


async def test_an_account_without_ether_is_named_where_it_has_to_pay_gas(ward: Ward) -> None:
    person = await ward.examined("person", "robot", **poor(ward))
    agent = await ward.examined("agent", "robot", **poor(ward))

    assert {"ether", "tokens", "allowance"} == set(person.failed)
    assert "has 0 ETH: gas for no transaction" in person.one("ether").found
    assert "send it " in person.one("ether").do
    assert agent.failed == []
    assert agent.one("ether").verdict is Verdict.WARN


async def test_a_provider_without_a_stake_is_told_how_to_get_one(ward: Ward) -> None:
    found = await ward.examined("provider", "stranger")

    cause = found.cause("stake")
    assert f"has no stake at the lighthouse {LIGHTHOUSE}" in cause
    assert "aira lighthouse join" in cause
    assert "turn" not in found


async def test_a_missing_allowance_is_named_with_the_command_that_gives_it(ward: Ward) -> None:
    person = await ward.examined("person", "person")
    ward.town.ask("person", lambda chain: chain.approve(chain.factory, 0))
    try:
        without = await ward.examined("person", "person")
    finally:
        ward.town.ask("person", lambda chain: chain.approve(chain.factory, 1_000 * XRT))

    assert person.one("allowance").found == "the factory may take 1,000 XRT"
    finding = without.one("allowance")
    assert finding.verdict is Verdict.WARN
    assert "the factory may take no XRT from" in finding.found
    assert "`aira xrt approve factory AMOUNT`" in finding.do


async def test_the_turn_of_another_is_told(router: EmbeddedRouter, anvil: Anvil, tmp_path: Path) -> None:
    first, second = (Account.from_key(key) for key in anvil.private_keys[:2])
    plan = DeploymentPlan(timeout_blocks=100)
    deployed = await deploy(anvil.url, first, plan=plan)
    for account in (first, second):
        async with Chain(anvil.url, account=account, timing=TIMING) as chain:
            if account is first:
                await chain.transfer(second.address, 100 * XRT)
            await chain.become_provider(deployed.lighthouse, 10 * XRT)
    write_keyfile(tmp_path / "second.json", anvil.private_keys[1], PASSWORD)
    (tmp_path / "password").write_text(PASSWORD)
    (tmp_path / "password").chmod(0o600)
    settings = Settings(
        connect=(router.endpoint,),
        web3_http_provider=anvil.url,
        data_dir=str(tmp_path),
        keyfile=str(tmp_path / "second.json"),
        keyfile_password_file=str(tmp_path / "password"),
        lighthouse_contract=deployed.lighthouse_name,
    )

    found = await examined(Case(settings=settings, asked_role="provider"))

    assert found.failed == []
    assert found.one("turn").found.startswith(f"{first.address}'s (1 of 2)")
    assert found.one("turn").found.endswith("this account waits for its turn")


async def test_gas_above_the_own_ceiling_is_named(ward: Ward) -> None:
    found = await ward.examined("person", "person", max_fee_gwei=1e-9)

    assert "the ceiling is 1e-09 gwei" in found.cause("ether")


def ask(anvil: Anvil, method: str, *parameters: object) -> None:
    """Have the node do something that only such a node does."""
    body = json.dumps({"jsonrpc": "2.0", "id": 1, "method": method, "params": parameters}).encode()
    request = urllib.request.Request(anvil.url, body, {"Content-Type": "application/json"})
    with urllib.request.urlopen(request, timeout=30) as answer:
        assert "error" not in json.load(answer)
