"""Deploying the contracts."""

from __future__ import annotations

import re
import time
from typing import Any

import pytest

from mesh.chain import (
    XRT,
    Account,
    Chain,
    DeploymentPlan,
    InsufficientFunds,
    Node,
    NodeUnreachable,
    deploy,
    new_private_key,
)
from mesh.chain._abi import NAMES, load_artifact
from mesh.chain._names import DEVELOPMENT_REGISTRY
from mesh.chain.deploy import CANCUN_CODE, interrupted_deployment
from mesh.chain.errors import RequestRefused
from mesh.dev import EmbeddedChain
from mesh.dev._embedded import EmbeddedProvider
from mesh.errors import ChainError
from tests.mesh.chain.conftest import QUICK, OneAtATime, no_contracts
from tests.support.nodes import Anvil
from tests.support.raising import raises_with


async def test_a_fresh_chain_takes_less_than_three_seconds_of_cpu() -> None:
    took = list[float]()
    # The first loads the EVM, perhaps while its coverage is measured; others on the machine slow the processor down.
    while len(took) < 5 and min(took, default=3.0) >= 3:
        started = time.process_time()
        async with EmbeddedChain() as node:
            await deploy(node.provider, Account(node.funded_keys[0]))
        took.append(time.process_time() - started)
    assert min(took) < 3


async def test_the_deployment_follows_its_plan() -> None:
    terms = {"initial_supply": 7 * XRT, "minimal_stake": 5, "timeout_blocks": 9, "refund_delay": 33}
    plan = DeploymentPlan(lighthouse="home", emission_percent=256, **terms)
    async with EmbeddedChain() as node:
        account = Account(node.funded_keys[3])
        deployment = await deploy(node.provider, account, plan=plan)
        async with Chain(node.provider, contracts=deployment.contracts, timing=QUICK) as chain:
            assert await chain.tokens.balance(account.address) == 7 * XRT
            assert await chain.names.address("home.lighthouse.5.robonomics.eth") == deployment.lighthouse
            assert deployment.lighthouse_name == "home.lighthouse.3.robonomics.eth"
            state = await chain.lighthouses.get("home")
            assert (state.minimal_stake, state.timeout_blocks) == (5, 9)
            assert await chain.block_number() == deployment.block_number
            factory = chain.node.contract("Factory", chain.factory)
            assert [await chain.node.read(call) for call in (factory.refundDelay(), factory.wnFromGas(50))] == [33, 128]


async def test_the_first_deployment_of_a_development_chain_is_found_without_an_address() -> None:
    async with EmbeddedChain() as node:
        with no_contracts("ENS registry"):
            async with Chain(node.provider, timing=QUICK):
                pass
        deployment = await deploy(node.provider, Account(node.funded_keys[0]))
        assert deployment.ens == DEVELOPMENT_REGISTRY
        async with Chain(node.provider, timing=QUICK) as chain:
            assert chain.factory == deployment.factory


async def test_deploying_needs_funds() -> None:
    async with EmbeddedChain() as node:
        with pytest.raises(InsufficientFunds):
            await deploy(node.provider, Account(new_private_key()))


async def test_a_deployment_that_is_interrupted_after_each_transaction_is_continued() -> None:
    async with EmbeddedChain() as chain:
        account = Account(chain.funded_keys[0])
        node = OneAtATime(chain.provider)
        for _ in range(21):
            node.allow()
            with raises_with(RequestRefused, code="above-nodes-cap", match="exceeds the configured cap") as refused:
                await deploy(node, account)
            gas = int(re.findall(r"\(([0-9,]+) gas\)", str(refused.value))[0].replace(",", ""))
            assert f"until gas costs less than {10**9 / gas:.3g} gwei" in refused.value.hint
            assert "`aira chain deploy` goes on" in refused.value.hint
        node.allow()
        deployment = await deploy(node, account)
        assert node.taken == 22, "nothing was sent twice"
        assert deployment.ens == DEVELOPMENT_REGISTRY
        async with Chain(chain.provider, timing=QUICK) as opened:
            assert (opened.factory, opened.xrt) == (deployment.factory, deployment.xrt)
            for generation in (3, 5):
                assert await opened.names.address(f"xrt.{generation}.robonomics.eth") == deployment.xrt
                assert await opened.names.address(f"factory.{generation}.robonomics.eth") == deployment.factory
                name = f"airalab.lighthouse.{generation}.robonomics.eth"
                assert await opened.names.address(name) == deployment.lighthouse
            minter = opened.node.contract("XRT", deployment.xrt).minter()
            assert await opened.node.read(minter) == deployment.factory
        again = await deploy(chain.provider, account)
        assert again.ens != deployment.ens, "one that is complete is not continued"


async def test_what_another_plan_deployed_is_not_continued_with() -> None:
    async with EmbeddedChain() as chain:
        account = Account(chain.funded_keys[0])
        node = OneAtATime(chain.provider)
        for _ in range(4):
            node.allow()
            with pytest.raises(RequestRefused):
                await deploy(node, account, plan=DeploymentPlan(initial_supply=5, refund_delay=9))
        deployment = await deploy(chain.provider, account, plan=DeploymentPlan(initial_supply=6, refund_delay=9))
        assert deployment.ens == DEVELOPMENT_REGISTRY
        async with Chain(chain.provider, timing=QUICK) as opened:
            assert await opened.tokens.balance(account.address) == 6
            assert await opened.node.read(opened.node.contract("Factory", opened.factory).xrt()) == opened.xrt


@pytest.mark.parametrize("hardfork", ["london", "shanghai"])
async def test_nothing_is_sent_to_a_chain_before_cancun(hardfork: str) -> None:
    with Anvil(arguments=["--hardfork", hardfork]) as anvil:
        account = Account(anvil.private_keys[0])
        with pytest.raises(ChainError, match="older than Cancun"):
            await deploy(anvil.url, account)
        async with Node(anvil.url) as node:
            assert await node.transaction_count(account.address) == 0


class Mempool(EmbeddedProvider):
    """A chain that is lost with its 22nd transaction, the last, which is mined when it was counted as pending twice."""

    sent = 0
    counted = 0
    held: Any = None

    async def make_request(self, method: str, params: Any) -> Any:
        if method == "eth_sendRawTransaction":
            self.sent += 1
            if self.sent == 22:
                self.held = params
            if self.sent >= 22 and self.held is not None:
                raise ConnectionError("the wire is cut")
        answer = await super().make_request(method, params)
        if method == "eth_getTransactionCount" and params[1] == "pending" and self.held is not None:
            self.counted += 1
            answer["result"] = hex(int(answer["result"], 16) + 1)
            if self.counted == 2:
                await super().make_request("eth_sendRawTransaction", self.held)
                self.held = None
        return answer


async def test_a_transaction_that_waits_belongs_to_the_interrupted_deployment() -> None:
    async with EmbeddedChain() as chain:
        owner = Account(chain.funded_keys[0])
        wire = Mempool(chain)
        with pytest.raises(NodeUnreachable):
            await deploy(wire, owner)
        async with Node(wire, timing=QUICK) as node:
            assert await interrupted_deployment(node, owner.address, DeploymentPlan()) == {}, "its end was on the way"


def test_every_new_opcode_of_the_contracts_is_in_the_check_of_the_chain() -> None:
    new, found = {0x5F, 0x5E, 0x5C, 0x5D, 0x49, 0x4A, 0x1E}, set[int]()
    for name in NAMES:
        code, at = load_artifact(name).bytecode, 0
        while at < len(code):
            found |= {code[at]} & new
            at += 1 + (code[at] - 0x5F if 0x60 <= code[at] < 0x80 else 0)
    assert found == set(bytes.fromhex(CANCUN_CODE[2:])) & new
