"""web3's client of an open chain: any contract, with the retries and the transactions of the chain."""

from __future__ import annotations

import asyncio
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import pytest
from web3.exceptions import ContractCustomError, TransactionNotFound, Web3RPCError

from mesh.chain import Account, Chain, NodeUnreachable, Reverted, new_private_key
from mesh.chain._abi import load_artifact
from mesh.dev import EmbeddedChain
from mesh.errors import ClosedError
from tests.mesh.chain.conftest import QUICK, Flaky, prepare
from tests.support.waiting import until

if TYPE_CHECKING:
    from tests.mesh.chain.conftest import DeployedMarket

pytestmark = pytest.mark.asyncio(loop_scope="module")

ABI = list(load_artifact("XRT").abi)


async def test_another_contract_is_read_and_sent_to(market: DeployedMarket) -> None:
    async with market.chain(market.promisee) as chain:
        token: Any = chain.web3.eth.contract(chain.web3.to_checksum_address(chain.xrt), abi=ABI)
        stranger, before = market.stranger.address, await chain.tokens.balance(market.stranger.address)
        sent = [token.functions.transfer(stranger, amount).transact() for amount in (3, 4, 5)]
        hashes = await asyncio.gather(*sent, chain.tokens.transfer(stranger, 6))  # they share the account's nonces
        assert len(set(map(str, hashes))) == 4
        assert await token.functions.balanceOf(stranger).call() == before + 18
        receipt = await chain.web3.eth.get_transaction_receipt(hashes[0])
        assert token.events.Transfer().process_receipt(receipt)[0]["args"]["value"] == 3

        block: Any = await chain.web3.eth.get_block("latest", full_transactions=True)
        assert block["transactions"][0]["from"] == market.promisee.address
        head = await chain.web3.eth.get_block(block["hash"])
        assert head["number"] == block["number"]
        sent_value = await chain.web3.eth.send_transaction({"to": stranger, "value": 7})  # type: ignore[typeddict-item]
        assert (await chain.web3.eth.get_transaction(sent_value))["value"] == 7
        assert await chain.web3.is_connected()


async def test_a_new_contract_is_deployed(market: DeployedMarket) -> None:
    async with market.chain(market.promisee) as chain:
        contract: Any = chain.web3.eth.contract(abi=ABI, bytecode=load_artifact("XRT").bytecode)
        receipt = await chain.web3.eth.get_transaction_receipt(await contract.constructor(9).transact())
        token: Any = contract(receipt["contractAddress"])
        assert await token.functions.balanceOf(market.promisee.address).call() == 9


async def test_what_a_contract_refuses_is_an_error_of_web3_when_read_and_of_the_chain_when_sent(
    market: DeployedMarket,
) -> None:
    async with market.chain(market.stranger) as chain:
        token: Any = chain.web3.eth.contract(chain.web3.to_checksum_address(chain.xrt), abi=ABI)
        transfer = token.functions.transferFrom(market.provider.address, market.stranger.address, 1)
        with pytest.raises(ContractCustomError):
            await transfer.call()
        with pytest.raises(Reverted, match="ERC20InsufficientAllowance"):
            await transfer.transact()
        with pytest.raises(TransactionNotFound):
            await chain.web3.eth.get_transaction_receipt("0x" + "00" * 32)  # type: ignore[arg-type]
        with pytest.raises(Web3RPCError):
            await chain.web3.manager.coro_request("eth_unheardOf", [])  # type: ignore[arg-type]


async def test_without_an_account_nothing_is_sent(market: DeployedMarket) -> None:
    async with market.chain() as chain:
        assert not chain.web3.eth.default_account
        token: Any = chain.web3.eth.contract(chain.web3.to_checksum_address(chain.xrt), abi=ABI)
        unknown = Account(new_private_key())  # development chains know the keys of some accounts
        with pytest.raises(Web3RPCError):
            await token.functions.transfer(market.stranger.address, 0).transact({"from": unknown.address})


async def test_requests_of_web3_survive_a_short_outage_and_say_when_the_node_is_lost() -> None:
    async with EmbeddedChain() as node:
        market = await prepare(node.provider, node.funded_keys)
        flaky = Flaky(node)
        patient = replace(QUICK, attempts=10)
        async with Chain(flaky, timing=patient) as chain:
            flaky.is_lost, before = True, flaky.asked
            asked = asyncio.create_task(chain.web3.eth.get_code(market.deployment.xrt))  # type: ignore[arg-type]
            await until(lambda: flaky.asked > before + 1)
            flaky.is_lost = False
            assert await asked
        async with Chain(flaky, timing=QUICK) as chain:
            flaky.is_lost = True
            with pytest.raises(NodeUnreachable):
                await chain.web3.eth.block_number
            assert not await chain.web3.is_connected()


async def test_a_closed_chain_has_no_client(market: DeployedMarket) -> None:
    async with market.chain() as chain:
        client = chain.web3
    with pytest.raises(ClosedError):
        _ = chain.web3
    with pytest.raises(ClosedError):
        await client.eth.block_number
