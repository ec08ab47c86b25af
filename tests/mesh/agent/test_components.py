"""The chain that the settings describe: each option reaches it, and sent transactions are written to disk."""

from __future__ import annotations

import asyncio
import sqlite3
import sys
from contextlib import closing
from typing import TYPE_CHECKING, Any

import pytest

from mesh.chain import GWEI, Account, FeeTooHigh, UnknownName, deploy, new_private_key
from mesh.chain.errors import NotOffered
from mesh.errors import ConfigurationError
from mesh.role.composition import chain_of
from mesh.settings import Settings
from tests.support.development import serve_embedded

if TYPE_CHECKING:
    from collections.abc import AsyncIterator
    from pathlib import Path

    from tests.support.development import ServedChain

PAYING = """
import asyncio, sys
from mesh.role.composition import chain_of
from mesh.chain import Account
from mesh.settings import load

async def main(key, friend, count):
    async with chain_of(load(), Account(bytes.fromhex(key))) as chain:
        await asyncio.gather(*(chain.tokens.transfer(friend, 1) for _ in range(int(count))))

asyncio.run(main(*sys.argv[1:]))
"""


@pytest.fixture
async def served() -> AsyncIterator[ServedChain]:
    """A chain with the contracts, which the first of its accounts has deployed."""
    async with serve_embedded() as running:
        await deploy(running.node.provider, Account(running.node.funded_keys[0]))
        yield running


def settings(served: ServedChain, folder: Path, **options: Any) -> Settings:
    fields: dict[str, Any] = {"web3_http_provider": served.url, "data_dir": str(folder), "poll_interval": 0.05}
    return Settings(**(fields | options))


def account(served: ServedChain) -> Account:
    return Account(served.node.funded_keys[0])


def test_all_that_is_set_is_passed_on(tmp_path: Path) -> None:
    chain = chain_of(
        Settings(
            web3_http_provider="http://a:1, ws://b:2",
            data_dir=str(tmp_path),
            generation=5,
            poll_interval=0.5,
            confirmations=4,
            reorg_depth=40,
            max_fee_gwei=0.25,
        ),
        None,
    )
    assert chain.node.endpoint == "http://a:1, ws://b:2"
    assert chain.generation == 5
    timing = chain.node.timing
    assert (timing.poll_interval, timing.confirmations, timing.reorg_depth) == (0.5, 4, 40)
    assert chain.node.fees.ceiling == GWEI // 4
    assert list(tmp_path.iterdir()) == []


def test_an_invalid_address_of_a_node_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(ConfigurationError) as caught:
        chain_of(Settings(web3_http_provider="http://a:1,nowhere"), None)
    assert caught.value.code == "invalid-endpoint"
    assert str(caught.value).startswith("'nowhere' is not")


@pytest.mark.sample("generation")
@pytest.mark.parametrize("generation", [3, 5])
async def test_names_are_those_of_the_generation(served: ServedChain, tmp_path: Path, generation: int) -> None:
    async with chain_of(settings(served, tmp_path, generation=generation), None) as chain:
        assert chain.factory == await chain.names.address(f"factory.{generation}.robonomics.eth")
        assert chain.xrt == await chain.names.address(f"xrt.{generation}.robonomics.eth")
        lighthouse = f"airalab.lighthouse.{generation}.robonomics.eth"
        assert await chain.names.lighthouse("airalab") == await chain.names.address(lighthouse)


async def test_the_contracts_may_be_the_original_ones(served: ServedChain, tmp_path: Path) -> None:
    async with chain_of(settings(served, tmp_path, contracts="original", generation=5), None) as chain:
        with pytest.raises(NotOffered) as caught:
            await chain.liabilities.refundable_from(chain.factory)
    assert (caught.value.code, caught.value.generation) == ("not-offered", 5)


async def test_another_token_may_be_xrt(served: ServedChain, tmp_path: Path) -> None:
    async with chain_of(settings(served, tmp_path), None) as chain:
        factory = chain.factory
    async with chain_of(settings(served, tmp_path, xrt_contract=factory), None) as chain:
        assert chain.xrt == factory
        with pytest.raises(UnknownName):
            await chain.names.address("no.xrt.3.robonomics.eth")


async def test_gas_above_the_ceiling_is_not_bought(served: ServedChain, tmp_path: Path) -> None:
    dear = settings(served, tmp_path, max_fee_gwei=1e-9)
    async with chain_of(dear, account(served)) as chain:
        with pytest.raises(FeeTooHigh) as caught:
            await chain.tokens.approve(chain.factory, 1)
    assert (caught.value.code, caught.value.ceiling) == ("fee-too-high", 1)


async def test_the_next_run_continues_an_unconfirmed_transaction(served: ServedChain, tmp_path: Path) -> None:
    """A transfer was cancelled while it waited for its transaction; the next agent does not send the same again."""
    mine, friend = account(served), Account(new_private_key()).address
    async with chain_of(settings(served, tmp_path, confirmations=1000), mine) as chain:
        sending = asyncio.create_task(chain.tokens.transfer(friend, 7))
        while await chain.tokens.balance(friend) == 0:
            await asyncio.sleep(0.01)
        sending.cancel()
        await asyncio.wait([sending])
    async with chain_of(settings(served, tmp_path), mine) as chain:
        await chain.tokens.transfer(friend, 7)
        assert await chain.tokens.balance(friend) == 7
        await chain.tokens.transfer(friend, 7)
        assert await chain.tokens.balance(friend) == 14


async def test_programs_of_one_account_do_not_disturb_each_other(served: ServedChain, tmp_path: Path) -> None:
    friend = Account(new_private_key()).address
    key = served.node.funded_keys[0].hex()
    variables = {"AIRA_WEB3_HTTP_PROVIDER": served.url, "AIRA_DATA_DIR": str(tmp_path), "AIRA_POLL_INTERVAL": "0.05"}
    programs = [
        await asyncio.create_subprocess_exec(
            *(sys.executable, "-c", PAYING, key, friend, "6"),
            env=variables,
            stdout=asyncio.subprocess.PIPE,
            stderr=asyncio.subprocess.STDOUT,
        )
        for _ in range(3)
    ]
    said = [(await program.communicate())[0].decode() for program in programs]
    assert said == [""] * 3
    async with chain_of(settings(served, tmp_path), None) as chain:
        assert await chain.tokens.balance(friend) == 18
    assert left_in_the_journal(tmp_path) == [], "all of them are settled"


def left_in_the_journal(folder: Path) -> list[int]:
    """The numbers of the account's transactions that are kept."""
    (file,) = folder.glob("transactions/*/*/transactions.sqlite")
    with closing(sqlite3.connect(file)) as database:
        return [nonce for (nonce,) in database.execute("SELECT nonce FROM transactions")]
