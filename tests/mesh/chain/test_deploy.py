"""Deploying the contracts."""

from __future__ import annotations

import time

import pytest

from mesh.chain import XRT, Account, Chain, DeploymentPlan, InsufficientFunds, deploy, new_private_key
from mesh.chain.names import DEVELOPMENT_REGISTRY
from mesh.devchain import EmbeddedChain
from tests.mesh.chain.conftest import QUICK, no_contracts


async def test_a_fresh_chain_takes_less_than_three_seconds_of_cpu() -> None:
    took = list[float]()
    # The first loads the EVM, perhaps while its coverage is measured; others on the machine slow the processor down.
    while len(took) < 5 and min(took, default=3.0) >= 3:
        started = time.process_time()
        async with EmbeddedChain() as node:
            await deploy(node.provider, Account.from_key(node.funded_keys[0]))
        took.append(time.process_time() - started)
    assert min(took) < 3


async def test_the_deployment_follows_its_plan() -> None:
    plan = DeploymentPlan(lighthouse="home", initial_supply=7 * XRT, minimal_stake=5, timeout_blocks=9, refund_delay=33)
    async with EmbeddedChain() as node:
        account = Account.from_key(node.funded_keys[3])
        deployment = await deploy(node.provider, account, plan=plan)
        async with Chain(node.provider, ens=deployment.ens, timing=QUICK) as chain:
            assert await chain.tokens.balance(account.address) == 7 * XRT
            assert await chain.names.address("home.lighthouse.5.robonomics.eth") == deployment.lighthouse
            assert deployment.lighthouse_name == "home.lighthouse.3.robonomics.eth"
            state = await chain.lighthouses.get("home")
            assert (state.minimal_stake, state.timeout_blocks) == (5, 9)
            assert await chain.block_number() == deployment.block_number
            refund_delay = chain.node.contract("Factory", chain.factory).refundDelay()
            assert await chain.node.read(refund_delay) == 33


async def test_the_first_deployment_of_a_development_chain_is_found_without_an_address() -> None:
    async with EmbeddedChain() as node:
        with no_contracts("ENS registry"):
            async with Chain(node.provider, timing=QUICK):
                pass
        deployment = await deploy(node.provider, Account.from_key(node.funded_keys[0]))
        assert deployment.ens == DEVELOPMENT_REGISTRY
        async with Chain(node.provider, timing=QUICK) as chain:
            assert chain.factory == deployment.factory


async def test_deploying_needs_funds() -> None:
    async with EmbeddedChain() as node:
        with pytest.raises(InsufficientFunds):
            await deploy(node.provider, Account.from_key(new_private_key()))
