"""Providers and their turns."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from tests.support.contracts.rounds import TIMEOUT, Round
from tests.support.contracts.suite import XRT

if TYPE_CHECKING:
    from tests.support.contracts.market import Market

pytestmark = pytest.mark.sample("market")


def test_a_turn_has_as_many_transactions_as_minimal_stakes(market: Market) -> None:
    turns = Round(market, [2, 1, 3])
    first, second, third = turns.providers[:3]
    expected = [first, first, second, third, third, third, first]
    for provider in expected:
        assert turns.may_send(first, second, third) == [provider is other for other in (first, second, third)]
        turns.send(provider)


def test_getters_tell_the_turn_under_both_generations_names(market: Market) -> None:
    turns = Round(market, [2, 1])
    first, second = turns.providers[:2]
    assert (turns.read("marker"), turns.read("quota"), turns.read("current")) == (1, 2, first.address)
    turns.send(first)
    turns.send(first)
    block = turns.suite.web3.eth.block_number
    assert (turns.read("marker"), turns.read("quota"), turns.read("current")) == (2, 1, second.address)
    for fifth, third, value in (
        ("keepAliveBlock", "keepaliveBlock", block),
        ("minimalStake", "minimalFreeze", XRT),
        ("timeoutInBlocks", "timeoutBlocks", TIMEOUT),
        ("providersLength", "membersLength", 2),
    ):
        assert turns.read(fifth) == turns.read(third) == value
    assert turns.read("providers", 1) == turns.read("members", 1) == second.address
    assert turns.read("stakes", first.address) == turns.read("balances", first.address) == 2 * XRT
    assert turns.read("quotaOf", first.address) == 2
    assert [turns.read("indexOf", person.address) for person in (first, second, market.outsider)] == [1, 2, 0]
    for name in ("providers", "members"):
        assert market.refusal(turns.lighthouse.functions[name](2)) == ("NoSuchProvider", 2)


def test_an_account_without_a_stake_is_not_a_provider(market: Market) -> None:
    call = market.creation(*market.pair())
    assert market.refusal(call, market.outsider) == ("NotAProvider", market.outsider.address)
    nobodys = Round(market, [])
    orders = market.pair(lighthouse=nobodys.lighthouse.address)
    refusal = market.refusal(market.creation(*orders, lighthouse=nobodys.lighthouse))
    assert refusal == ("NotAProvider", market.provider.address)


def test_the_refusal_out_of_turn_names_the_current_provider(market: Market) -> None:
    turns = Round(market, [2, 1])
    call = market.creation(*market.pair(lighthouse=turns.lighthouse.address), lighthouse=turns.lighthouse)
    assert market.refusal(call, turns.providers[1]) == ("NotYourTurn", turns.providers[0].address, 2)


def test_silence_lets_the_next_provider_send_and_then_all(market: Market) -> None:
    turns = Round(market, [2, 1, 1])
    people = first, _, third = turns.providers[:3]
    turns.send(first)
    turns.suite.chain.mine(TIMEOUT - 1)
    assert turns.may_send(*people) == [True, False, False]
    turns.suite.chain.mine(1)
    assert turns.may_send(*people) == [True, True, False]
    turns.suite.chain.mine(TIMEOUT)
    assert turns.may_send(*people) == [True, True, True]
    turns.send(third)
    assert turns.read("current") == first.address


def test_a_provider_cannot_keep_the_turn_by_waiting(market: Market) -> None:
    """It may use the rest of its quota at any time, but gets no new one before the next provider had a turn."""
    turns = Round(market, [2, 1])
    first, second = turns.providers[:2]
    turns.send(first)
    turns.suite.chain.mine(TIMEOUT)
    turns.send(first)
    assert turns.may_send(first, second) == [False, True]
    turns.suite.chain.mine(TIMEOUT - 1)
    assert turns.may_send(first, second) == [False, True]


def test_a_silent_provider_does_not_stop_others(market: Market) -> None:
    turns = Round(market, [1, 1])
    first = turns.providers[0]
    for _ in range(3):
        turns.send(first)
        turns.suite.chain.mine(TIMEOUT)


def test_is_turn_of_agrees_with_the_transactions_that_are_allowed(market: Market) -> None:
    turns = Round(market, [1, 1, 1])
    people = turns.providers[:3]
    assert [turns.read("isTurnOf", person.address) for person in people] == [True, False, False]
    assert not turns.read("isTurnOf", market.outsider.address)
    turns.suite.chain.mine(TIMEOUT + 1)
    assert [turns.read("isTurnOf", person.address) for person in people] == turns.may_send(*people)
