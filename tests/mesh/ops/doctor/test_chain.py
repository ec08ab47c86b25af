"""The chain, its clock and its contracts: sound ones, and each thing that can be wrong."""

from __future__ import annotations

import json
import time
import urllib.request
from typing import TYPE_CHECKING

import pytest

from mesh.ops.doctor import CheckStatus
from mesh.ops.doctor._chain import is_stalled
from tests.support.nodes import Anvil
from tests.support.ports import free_port

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    from tests.support.doctor.machines import Machine


async def test_an_agent_with_an_account_passes(machine: Machine) -> None:
    found = await machine.examined("agent", "robot")

    assert found.failed == []
    statuses = {result.code: result.status for results in found.values() for result in results}
    statuses.pop("disk-slow", None)  # other programs may keep it busy
    assert set(statuses.values()) == {CheckStatus.OK}
    assert machine.town.url in found.one("node").message
    assert found.one("contracts").code == "own"
    assert "1 provider" in found.one("lighthouse").message
    assert machine.town.people["robot"].address in found.one("keyfile").message
    assert "1,000 XRT" in found.one("tokens").message


async def test_a_provider_with_a_stake_passes_and_sees_the_turn(machine: Machine) -> None:
    found = await machine.examined("provider", "provider")

    assert found.failed == []
    assert "100 transactions per turn" in found.one("stake").message
    assert found.one("turn").code == "own-turn"


async def test_only_a_requested_agent_role_needs_an_account(machine: Machine) -> None:
    looking = await machine.examined(None)
    asked = await machine.examined("agent")

    assert looking.failed == []
    assert "keyfile" not in looking
    assert "`aira account new`" in asked.cause("keyfile").hint


async def test_an_unreachable_node_is_named_once(machine: Machine) -> None:
    url = f"http://127.0.0.1:{free_port()}"
    found = await machine.examined("agent", "robot", web3_http_provider=url)

    cause = found.cause("node")
    assert cause.code == "node-unreachable"
    assert url in cause.message
    assert "aira chain up" in cause.hint
    assert found.one("keyfile").ok
    assert found.one("data folder").ok


async def test_an_unexpected_chain_is_reported_with_both_chain_ids(machine: Machine) -> None:
    found = await machine.examined("agent", chain_id=1)

    assert found.one("chain").code == "other-chain"
    assert "chain" in found.failed
    assert "contracts" not in found


async def test_nodes_of_different_chains_fail(machine: Machine, anvil: Anvil) -> None:
    found = await machine.examined("bridge", web3_http_provider=f"{machine.town.url}, {anvil.url}")

    assert [result.ok for result in found["node"]] == [True, True]
    assert (found.one("chain").ok, found.one("chain").code) == (False, "wrong-chain")


async def test_a_chain_without_the_contracts_fails_once(machine: Machine, anvil: Anvil) -> None:
    found = await machine.examined("agent", "robot", web3_http_provider=anvil.url)

    cause = found.cause("contracts")
    assert cause.code == "no-contracts"
    assert "aira chain deploy" in cause.hint
    assert found.one("chain").ok
    assert "lighthouse" not in found


async def test_unregistered_names_are_reported(machine: Machine) -> None:
    factory = await machine.examined("agent", "robot", factory_contract="factory.7.robonomics.eth")
    market = await machine.examined("agent", "robot", lighthouse_contract="nowhere.lighthouse.3.robonomics.eth")
    token = await machine.examined("agent", "robot", erc20_token="gold.3.robonomics.eth")

    for result, code, name in (
        (factory.cause("contracts"), "no-contracts", "factory.7.robonomics.eth"),
        (market.cause("lighthouse"), "unknown-name", "nowhere.lighthouse.3.robonomics.eth"),
        (token.one("token"), "unknown-name", "gold.3.robonomics.eth"),
    ):
        assert result.code == code
        assert name in result.message


async def test_an_address_that_is_no_lighthouse_of_the_factory_is_named(machine: Machine) -> None:
    found = await machine.examined("agent", "robot", lighthouse_contract=machine.town.deployment.xrt)

    assert found.cause("lighthouse").code == "not-a-lighthouse"


async def test_the_wrong_kind_of_contracts_fails(machine: Machine) -> None:
    found = await machine.examined("agent", contracts="original")

    assert found.one("contracts").code == "our-contracts"
    assert found.one("contracts").hint == "give --contracts mesh"


async def test_a_configured_websocket_must_answer(machine: Machine) -> None:
    dead = f"ws://127.0.0.1:{free_port()}"
    alive = machine.town.url.replace("http", "ws")

    assert dead in (await machine.examined(None, web3_ws_provider=dead)).cause("websocket").message
    assert (await machine.examined(None, web3_ws_provider=alive)).one("websocket").ok


async def test_a_malformed_node_address_fails(machine: Machine) -> None:
    assert (await machine.examined(None, web3_http_provider="8545")).cause("node").code == "invalid-endpoint"


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
    assert is_stalled(client, number=7, age=age) is still
    assert not is_stalled(client, number=0, age=age)


async def test_an_old_block_of_a_development_chain_says_nothing_about_the_clock(machine: Machine) -> None:
    with Anvil(arguments=("--timestamp", str(int(time.time()) - 86_400))) as old:
        ask(old, "evm_setNextBlockTimestamp", int(time.time()) - 7_300)
        ask(old, "anvil_mine", "0x1")
        found = await machine.examined(None, web3_http_provider=old.url)

    assert found.one("node").ok
    assert found.one("chain clock").code == "block-too-old"


async def test_a_clock_behind_the_chain_s_is_named(machine: Machine, anvil: Anvil) -> None:
    ask(anvil, "evm_setNextBlockTimestamp", int(time.time()) + 3_600)
    ask(anvil, "anvil_mine", "0x1")

    found = await machine.examined(None, web3_http_provider=anvil.url)

    result = found.one("chain clock")
    assert not result.ok
    assert result.code == "clock-behind"
    assert "60 minutes" in result.message


def ask(anvil: Anvil, method: str, *parameters: object) -> None:
    """Have the node do something that only such a node does."""
    body = json.dumps({"jsonrpc": "2.0", "id": 1, "method": method, "params": parameters}).encode()
    request = urllib.request.Request(anvil.url, body, {"Content-Type": "application/json"})
    with urllib.request.urlopen(request, timeout=30) as answer:
        assert "error" not in json.load(answer)


@pytest.fixture
async def gnosis() -> AsyncIterator[Anvil]:
    """A node of a chain with the number and the pace of Gnosis Chain."""
    async with Anvil(arguments=("--chain-id", "100")) as node:
        ask(node, "anvil_mine", "0x32", "0x5")
        yield node


async def test_a_known_chain_should_be_named(machine: Machine, gnosis: Anvil) -> None:
    found = await machine.examined("bridge", web3_http_provider=gnosis.url)
    assert (found.one("chain profile").status, found.one("chain profile").code) == (CheckStatus.WARN, "chain-not-named")
    assert 'chain = "gnosis"' in found.one("chain profile").hint


async def test_a_node_like_the_named_chains_passes(machine: Machine, gnosis: Anvil) -> None:
    for finality in ("latest", "safe", "finalized"):
        found = await machine.examined("bridge", web3_http_provider=gnosis.url, chain="gnosis", finality=finality)
        assert found.one("chain profile").status is CheckStatus.OK, found.one("chain profile")
        assert f"finality is {finality}" in found.one("chain profile").message


async def test_a_node_of_another_chain_than_the_named_one_fails(machine: Machine, gnosis: Anvil) -> None:
    found = await machine.examined("bridge", web3_http_provider=gnosis.url, chain="polygon")
    assert (found.one("chain").status, found.one("chain").code) == (CheckStatus.FAIL, "wrong-chain")
    assert "chain profile" not in found


async def test_another_pace_than_the_chains_is_a_warning(machine: Machine) -> None:
    async with Anvil(arguments=("--chain-id", "100")) as node:
        ask(node, "anvil_mine", "0x32", "0x3c")
        found = await machine.examined("bridge", web3_http_provider=node.url, chain="gnosis")
    assert (found.one("chain profile").status, found.one("chain profile").code) == (CheckStatus.WARN, "unlike-chain")
    assert "a block comes every 60 s, not every 5 s" in found.one("chain profile").message
