"""Liabilities that are paid in tokens of other people's making."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from schemas import keccak256
from tests.support.contracts.suite import REFUND_DELAY

if TYPE_CHECKING:
    from web3.contract import Contract

    from tests.support.contracts.market import Market

pytestmark = pytest.mark.sample("market")

COST = 1000


def funded(market: Market, name: str) -> Contract:
    """A token of which the promisee has enough."""
    token = market.suite.deploy(name, 10 * COST)
    if name != "RefusingToken":
        market.suite.send(token.functions.transfer(market.promisee.address, 2 * COST))
    return token


def test_a_token_that_returns_nothing_pays(market: Market) -> None:
    token = funded(market, "SilentToken")
    market.finalize(market.create(token=token.address, cost=COST))
    assert token.functions.balanceOf(market.promisor.address).call() == COST


def test_a_token_that_keeps_a_part_is_refused_before_it_can_lock_anything(market: Market) -> None:
    token = funded(market, "FeeToken")
    refusal = market.refusal(market.creation(*market.pair(token=token.address, cost=COST)))
    assert refusal == ("TokenAmountMismatch", token.address, COST, COST - COST // 100)


def test_a_transfer_that_returns_false_is_a_failure(market: Market) -> None:
    token = funded(market, "RefusingToken")
    refusal = market.refusal(market.creation(*market.pair(token=token.address, cost=COST)))
    assert refusal == ("TokenTransferFailed", token.address)


def test_an_account_is_not_a_token(market: Market) -> None:
    token = market.outsider.address
    assert market.refusal(market.creation(*market.pair(token=token, cost=COST))) == ("TokenTransferFailed", token)


def test_a_token_that_calls_back_is_paid_out_once(market: Market) -> None:
    suite = market.suite
    token = funded(market, "HookedToken")
    liability, _ = (market.create(token=token.address, cost=COST) for _ in range(2))
    suite.chain.mine(REFUND_DELAY)
    refund = suite.factory.encode_abi("refund", [liability.address])
    suite.send(token.functions.setHook(suite.factory.address, refund))

    market.finalize(liability)

    assert not token.functions.called().call()
    assert token.functions.answer().call()[:4] == keccak256(b"AlreadyFinalized(address)")[:4]
    balance = token.functions.balanceOf
    assert (balance(market.promisor.address).call(), balance(suite.factory.address).call()) == (COST, COST)


def test_the_minter_is_named_once_and_alone_mints(market: Market) -> None:
    suite = market.suite
    functions = suite.xrt.functions
    assert functions.minter().call() == suite.factory.address
    mint = functions.mint(market.outsider.address, 1)
    assert market.refusal(mint, suite.deployer) == ("NotTheMinter", suite.deployer.address)
    again = functions.setMinter(market.outsider.address)
    assert market.refusal(again, suite.deployer) == ("MinterAlreadySet",)
    assert market.refusal(again, market.outsider) == ("NotTheDeployer", market.outsider.address)


def test_xrt_is_an_erc20_token_with_nine_decimals(market: Market) -> None:
    suite = market.suite
    functions = suite.xrt.functions
    assert (functions.name().call(), functions.symbol().call(), functions.decimals().call()) == ("Robonomics", "XRT", 9)
    owner, spender = market.outsider, market.provider
    suite.send(functions.transfer(owner.address, 10))
    suite.send(functions.approve(spender.address, 4), owner)
    suite.send(functions.transferFrom(owner.address, spender.address, 3), spender)
    assert functions.allowance(owner.address, spender.address).call() == 1
    over = functions.transferFrom(owner.address, spender.address, 2)
    assert market.refusal(over, spender) == ("ERC20InsufficientAllowance", spender.address, 1, 2)
    assert market.refusal(functions.transfer(spender.address, 8), owner) == (
        "ERC20InsufficientBalance",
        owner.address,
        7,
        8,
    )
    zero = "0x" + "00" * 20
    assert market.refusal(functions.transfer(zero, 1), owner) == ("ERC20InvalidReceiver", zero)


def test_an_endless_approval_is_not_used_up(market: Market) -> None:
    suite = market.suite
    functions = suite.xrt.functions
    suite.send(functions.approve(suite.factory.address, 2**256 - 1), market.promisee)
    market.create(cost=COST)
    assert functions.allowance(market.promisee.address, suite.factory.address).call() == 2**256 - 1
