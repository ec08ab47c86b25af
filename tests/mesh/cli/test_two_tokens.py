"""Two tokens on one market at once: a robot that is paid in XRT, and one that is paid in a token with six decimals."""

from __future__ import annotations

import asyncio
import json
import re
import sys
from contextlib import asynccontextmanager
from typing import TYPE_CHECKING, Any

import pytest

from mesh.amounts import XRT
from mesh.chain import TransactionSender
from mesh.settings.chains import CHAINS
from schemas.address import shortened
from tests.mesh.cli.test_choosing import SPEAKER
from tests.mesh.cli.test_second_chances import LIFT
from tests.support.cli.site import Site
from tests.support.commands import AIRA, Serving, aira
from tests.support.contracts.suite import artifact
from tests.support.nodes import Anvil

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Iterator
    from pathlib import Path

    from mesh.chain import Chain
    from tests.support.routers import EmbeddedRouter

BASE = CHAINS["base"]
USDC = BASE.tokens["USDC"]
DOLLAR = 10**6
BALANCE, ALLOWANCE = 20 * DOLLAR, 10 * DOLLAR


@pytest.fixture
def anvil() -> Iterator[Anvil]:
    """A node that says that it is Base."""
    with Anvil(arguments=("--chain-id", str(BASE.chain_id))) as running:
        yield running


async def minted(chain: Chain, token: str, to: str) -> None:
    """Give an account 20 of the token, whose code is at that address."""
    data = bytes.fromhex("40c10f19") + bytes(12) + bytes.fromhex(to[2:]) + BALANCE.to_bytes(32)  # mint(address,uint256)
    assert chain.account is not None
    await TransactionSender(chain.node, chain.account).send(to=token, data=data)


class TwoTokens:
    """A site where USDC is at its address on Base, and the person has some of it."""

    def __init__(self, site: Site) -> None:
        self.site = site
        self.model, self._program = site.folder / "speaker.json", site.folder / "lift.py"
        self.model.write_bytes(SPEAKER.encode())
        self._program.write_text(LIFT)
        self.liar = ""
        """A stranger's token that calls itself USDC."""

    async def prepare(self) -> None:
        code = artifact("DollarToken")
        async with self.site.chain("person") as chain:
            await chain.node.request("anvil_setCode", USDC, "0x" + code["deployedBytecode"].removeprefix("0x"))
            creation = bytes.fromhex(code["bytecode"].removeprefix("0x"))
            receipt = await TransactionSender(chain.node, self.site.accounts["person"]).send(to=None, data=creation)
            assert receipt.contract is not None
            self.liar = receipt.contract
            for token in (USDC, self.liar):
                await minted(chain, token, self.site.address("person"))
                await chain.tokens.approve(chain.factory, ALLOWANCE, token=token)

    def robot(self, role: str, name: str, price: str, **options: str) -> Serving:
        options |= {"name": name, "data_dir": str(self.site.folder / role), "playback": "at-once"}
        words = (sys.executable, self._program, self.model, price, "works")
        return Serving(*words, says="account 0x", variables=self.variables(role, **options))

    @asynccontextmanager
    async def at_work(self) -> AsyncIterator[None]:
        dollars = {"erc20_token": "USDC", "least_price": "3 USDC"}
        async with (
            self.site.provider(),
            self.robot("robot", "Lift 1", "5 XRT"),
            self.robot("rival", "Lift 2", "3.50 USDC", **dollars),
        ):
            yield

    def variables(self, role: str, **options: str) -> dict[str, str]:
        return self.site.variables(role, chain="base", confirmations="1", **options)

    async def call(self, *words: str, **options: str) -> Any:
        return await asyncio.to_thread(aira, *words, **self.variables("person", **options))

    async def demand(self, word: str, *words: str, **options: str) -> Any:
        job = ("--model", str(self.model), "--objective", str(self.site.job(word)))
        return await self.call("demand", *job, *words, **options)

    async def balances(self, role: str) -> tuple[int, int]:
        """What an account has of XRT (wn) and USDC (millionths)."""
        async with self.site.chain(role) as chain:
            return await chain.tokens.balance(), await chain.tokens.balance(token=USDC)


@pytest.fixture
async def market(anvil: Anvil, router: EmbeddedRouter, tmp_path: Path) -> TwoTokens:
    market = TwoTokens(await Site.found(anvil.url, anvil.private_keys, router.endpoint, tmp_path))
    await market.prepare()
    return market


async def test_each_robot_is_paid_in_its_token_and_prices_are_compared_within_one(market: TwoTokens) -> None:
    robot, rival, person = [await market.balances(role) for role in ("robot", "rival", "person")]
    async with market.at_work():
        quotes = await market.call("quotes", "--model", str(market.model), "--objective", str(market.site.job("up")))
        offers = [re.split(r"\s{2,}", line)[0] for line in quotes.stdout.splitlines()]
        assert offers == ["cost", "5 XRT", "3.5 USDC"], quotes.stdout + quotes.stderr
        paid = await asyncio.gather(
            market.demand("up", "--robot", "cheapest", "--max-cost", "6 XRT"),
            market.demand("down", "--robot", "cheapest", "--max-cost", "4 USDC"),
        )
        assert [one.returncode for one in paid] == [0, 0], [one.stdout + one.stderr for one in paid]
        assert "posted " in paid[0].stdout
        assert ", 5 XRT for Lift 1 (" in paid[0].stdout
        assert ", 3.5 USDC for Lift 2 (" in paid[1].stdout
        dear = await market.demand("again", "--robot", "cheapest", "--max-cost", "3.2 USDC")
        for words in ("for 3.2 USDC: ", "wants 3.5 USDC", "wants 5 XRT", "[no-robot-fits]"):
            assert words in dear.stderr
        cheap = await market.demand("cheap", "--robot", "Lift 2", "--cost", "2.9 USDC")
        assert "at least 3 USDC (price-too-low)" in cheap.stderr
        false = await market.demand("false", "--robot", "Lift 2", "--cost", f"3.50 {market.liar}")
        assert "(price-too-low)" in false.stderr
    assert await market.balances("robot") == (robot[0] + 5 * 10**XRT.decimals, 0)
    assert await market.balances("rival") == (rival[0], 7 * DOLLAR // 2)
    assert await market.balances("person") == (person[0] - 5 * 10**XRT.decimals, person[1] - 7 * DOLLAR // 2)
    listed = await market.call("liability", "list")
    assert "1 contract paid: 5 XRT" in listed.stdout
    assert "1 contract paid: 3.5 USDC" in listed.stdout
    spent = json.loads((await market.call("statement", "--json")).stdout)["sums"]
    assert {(one["symbol"], one["spent"]) for one in spent} == {("XRT", "5000000000"), ("USDC", "3500000")}


@pytest.mark.parametrize("generation", ["3", "5"])
async def test_a_person_without_ether_pays_in_both_tokens_by_permits(market: TwoTokens, generation: str) -> None:
    """USDC's permits have another domain than XRT's, and two of one owner travel at a time."""
    person = market.site.address("person")
    orders = {"up": ("Lift 1", "5 XRT", "0.001 XRT"), "down": ("Lift 2", "3.50 USDC", "0.02 USDC")}
    robot, rival, had = [await market.balances(role) for role in ("robot", "rival", "person")]
    async with market.site.chain("person") as chain:
        for token in (chain.xrt, USDC):
            await chain.tokens.approve(chain.factory, 0, token=token)
        await chain.node.request("anvil_setBalance", person, "0x0")
        first, sent = await chain.block_number(), await chain.node.transaction_count(person, block="latest")
        async with market.at_work():
            done = await asyncio.gather(
                *(
                    market.demand(word, "--robot", name, "--cost", cost, "--permit-fee", fee, generation=generation)
                    for word, (name, cost, fee) in orders.items()
                )
            )
        assert [one.returncode for one in done] == [0, 0], [one.stdout + one.stderr for one in done]
        for block in range(first, await chain.block_number() + 1):
            assert await chain.node.request("eth_getBalance", person, hex(block)) == "0x0"
        assert await chain.node.transaction_count(person, block="pending") == sent
        left = [await chain.tokens.allowance(person, chain.factory, token=token) for token in (chain.xrt, USDC)]
        assert left == [0, 0], [one.stdout + one.stderr for one in done]
    five, half = 5 * 10**XRT.decimals, 7 * DOLLAR // 2
    assert await market.balances("robot") == (robot[0] + five, 0)
    assert await market.balances("rival") == (rival[0], half)
    assert await market.balances("person") == (had[0] - five - 10**XRT.decimals // 1000, had[1] - half - DOLLAR // 50)


async def test_a_token_that_only_calls_itself_usdc_is_shown_with_its_address(market: TwoTokens) -> None:
    shown = await market.call("xrt", "balance", "--token", market.liar)
    assert shown.stdout == f"20 USDC ({shortened(market.liar)})\n"
    assert (await market.call("xrt", "balance", "--token", "usdc")).stdout == "20 USDC\n"
    sent = await market.call("xrt", "transfer", market.site.address("robot"), "1.25 USDC", "--json")
    assert (json.loads(sent.stdout)["token"], json.loads(sent.stdout)["amount"]) == (USDC, "1250000")


async def test_a_watcher_sees_amounts_with_their_symbols(market: TwoTokens) -> None:
    watch = Serving(*AIRA, "watch", says="watching", variables=market.variables("person"))
    async with watch, market.at_work():
        await market.demand("up", "--robot", "Lift 2", "--cost", "3.50 USDC")
        await asyncio.to_thread(watch.wait_until_said, ", 3.5 USDC")
