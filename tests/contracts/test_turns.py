"""Providers, their stakes and their turns."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import pytest
from web3.logs import DISCARD

from tests.contracts.suite import XRT

if TYPE_CHECKING:
    from collections.abc import Iterable

    from web3.contract import Contract

    from tests.contracts.market import Market
    from tests.contracts.suite import Person, Suite

TIMEOUT = 10


class Round:
    """A lighthouse with the cheapest transactions: attempts to finalize an address that is not a liability."""

    def __init__(self, market: Market, stakes: Iterable[int]) -> None:
        self.market = market
        self.suite: Suite = market.suite
        self.lighthouse: Contract = self.suite.create_lighthouse(timeout=TIMEOUT, name="round")
        self.providers = self.suite.people[5:]
        for provider, stake in zip(self.providers, stakes, strict=False):
            self.suite.join(self.lighthouse, provider, stake * XRT)

    def send(self, provider: Person) -> None:
        """A transaction of that provider's, which must be allowed."""
        orders = self.market.pair(lighthouse=self.lighthouse.address)
        self.suite.send(self.market.creation(*orders, lighthouse=self.lighthouse), provider)

    def may_send(self, *providers: Person) -> list[bool]:
        """Which of these may send the next transaction."""
        call = self.market.creation(*self.market.pair(lighthouse=self.lighthouse.address), lighthouse=self.lighthouse)
        allowed = []
        for provider in providers:
            refusal = self.market.refusal(call, provider)
            assert refusal[:1] in ((), ("NotYourTurn",))
            allowed.append(refusal == ())
        return allowed

    def read(self, name: str, *arguments: Any) -> Any:
        """A getter's answer."""
        return self.lighthouse.functions[name](*arguments).call()


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


def test_stakes_can_be_withdrawn(market: Market) -> None:
    suite = market.suite
    turns = Round(market, [5])
    provider = turns.providers[0]
    before = suite.balance(provider)
    suite.send(turns.lighthouse.functions.withdraw(2 * XRT), provider)
    assert suite.balance(provider) == before + 2 * XRT
    assert (turns.read("quota"), turns.read("stakes", provider.address)) == (3, 3 * XRT)
    suite.send(turns.lighthouse.functions.withdraw(2 * XRT + 1), provider)
    assert suite.balance(provider) == before + 5 * XRT
    assert (turns.read("providersLength"), turns.read("marker"), turns.read("quota")) == (0, 0, 0)
    assert suite.balance(turns.lighthouse) == 0


@pytest.mark.parametrize("leaver", [0, 1, 2])
@pytest.mark.parametrize("passed", [0, 1, 2])
def test_a_lighthouse_goes_on_when_a_provider_leaves(market: Market, leaver: int, passed: int) -> None:
    turns = Round(market, [1, 1, 1])
    people = list(turns.providers[:3])
    for person in people[:passed]:
        turns.send(person)
    gone = people.pop(leaver)

    turns.suite.send(turns.lighthouse.functions.withdraw(XRT), gone)

    listed = [turns.read("providers", index) for index in range(2)]
    assert sorted(listed) == sorted(person.address for person in people)
    assert [turns.read("indexOf", address) for address in listed] == [1, 2]
    call = market.creation(*market.pair(lighthouse=turns.lighthouse.address), lighthouse=turns.lighthouse)
    assert market.refusal(call, gone) == ("NotAProvider", gone.address)
    by_address = {person.address: person for person in people}
    seen = []
    for _ in range(2):
        current = by_address[turns.read("current")]
        assert turns.may_send(*people) == [person is current for person in people]
        turns.send(current)
        seen.append(current)
    assert set(seen) == set(people)


@pytest.mark.parametrize("passed", [0, 1, 2])
def test_a_new_provider_waits_until_each_of_the_others_has_had_a_turn(market: Market, passed: int) -> None:
    turns = Round(market, [1, 1, 1])
    people = list(turns.providers[:3])
    for person in people[:passed]:
        turns.send(person)
    newcomer = turns.providers[3]
    turns.suite.join(turns.lighthouse, newcomer, XRT)
    people = people[passed:] + people[:passed] + [newcomer]
    for person in people * 2:
        assert turns.may_send(*people) == [person is other for other in people]
        turns.send(person)


@pytest.mark.parametrize("leaver", [0, 1, 2, 3])
@pytest.mark.parametrize("passed", [0, 1, 2, 3])
def test_no_provider_skips_the_queue_when_another_leaves(market: Market, leaver: int, passed: int) -> None:
    turns = Round(market, [1, 1, 1, 1])
    people = list(turns.providers[:4])
    for person in people[:passed]:
        turns.send(person)
    gone = people[leaver]
    turns.suite.send(turns.lighthouse.functions.withdraw(XRT), gone)
    people = [person for person in people[passed:] + people[:passed] if person is not gone]
    for person in people:
        assert turns.read("current") == person.address
        turns.send(person)


def test_leaving_in_its_turn_does_not_update_the_keep_alive_block(market: Market) -> None:
    turns = Round(market, [1, 1, 1])
    first, second, third = turns.providers[:3]
    alive = turns.read("keepAliveBlock")
    turns.suite.chain.mine(TIMEOUT)
    turns.suite.send(turns.lighthouse.functions.withdraw(XRT), first)
    assert (turns.read("current"), turns.read("keepAliveBlock")) == (second.address, alive)
    assert turns.may_send(second, third) == [True, True]


@pytest.mark.parametrize("working", [False, True], ids=["silent", "working"])
def test_two_providers_that_leave_and_return_do_not_keep_a_third_from_its_turn(market: Market, working: bool) -> None:
    turns = Round(market, [1, 1, 1])
    one, honest, two = turns.providers[:3]
    for leaver in [one, two] * 3:
        if turns.may_send(honest) == [True]:
            return
        if working and turns.may_send(leaver) == [True]:
            turns.send(leaver)
        turns.suite.chain.mine(TIMEOUT - 5)
        turns.suite.send(turns.lighthouse.functions.withdraw(XRT), leaver)
        turns.suite.join(turns.lighthouse, leaver, XRT)
    raise AssertionError("the honest provider never had a turn")


@pytest.mark.parametrize("leaver", [0, 1])
def test_who_becomes_the_next_one_has_a_timeout_alone(market: Market, leaver: int) -> None:
    """Else two accounts could pass the turn to each other over the heads of the others, by leaving in between."""
    turns = Round(market, [1, 1, 1, 1])
    people = list(turns.providers[:4])
    turns.suite.chain.mine(2 * TIMEOUT)
    assert turns.may_send(*people) == [True] * 4
    turns.suite.send(turns.lighthouse.functions.withdraw(XRT), people.pop(leaver))
    assert turns.may_send(*people) == [True, True, False]
    turns.suite.chain.mine(TIMEOUT - 1)
    assert turns.may_send(*people) == [True, True, False]
    turns.suite.chain.mine(1)
    assert turns.may_send(*people) == [True, True, True]


def test_two_providers_do_not_pass_the_turn_to_each_other(market: Market) -> None:
    """Each lets the other's turn time out and takes it, faster than the others; but who was next was silent as well."""
    turns = Round(market, [2, 1, 1, 2])
    one, idle, honest, two = turns.providers[:4]
    for rogue in [two, one] * 4:
        turns.suite.chain.mine(TIMEOUT)
        if turns.may_send(honest, one, idle, two).count(True) == 2 and turns.may_send(honest) == [True]:
            return
        turns.suite.chain.mine(TIMEOUT)
        turns.send(rogue)
    raise AssertionError("the honest provider never had a timeout for itself")


def test_who_passes_over_silent_providers_sends_them_to_the_end(market: Market) -> None:
    turns = Round(market, [1, 1, 1, 1])
    first, second, third, fourth = turns.providers[:4]
    turns.suite.chain.mine(2 * TIMEOUT)
    turns.send(fourth)
    for person in (third, first, second, fourth):
        assert turns.read("current") == person.address
        turns.send(person)


def test_a_provider_can_come_back(market: Market) -> None:
    turns = Round(market, [1, 1])
    first = turns.providers[0]
    turns.suite.send(turns.lighthouse.functions.withdraw(XRT), first)
    turns.suite.join(turns.lighthouse, first, XRT)
    assert turns.read("indexOf", first.address) == 2


def test_stakes_have_bounds(market: Market) -> None:
    suite = market.suite
    turns = Round(market, [])
    provider = turns.providers[0]
    suite.fund(provider, XRT, turns.lighthouse.address)
    functions = turns.lighthouse.functions
    assert market.refusal(functions.refill(XRT - 1), provider) == ("StakeTooSmall", XRT - 1, XRT)
    assert market.refusal(functions.refill(2 * XRT), provider)[0] == "ERC20InsufficientAllowance"
    assert market.refusal(functions.withdraw(0), provider) == ("NotAProvider", provider.address)
    suite.send(functions.refill(XRT), provider)
    assert market.refusal(functions.withdraw(XRT + 1), provider) == ("InsufficientStake", XRT, XRT + 1)


def test_coming_going_and_turns_are_announced(market: Market) -> None:
    turns = Round(market, [1])
    first, second = turns.providers[:2]
    suite, lighthouse = turns.suite, turns.lighthouse
    suite.fund(second, XRT, lighthouse.address)
    came = suite.send(lighthouse.functions.refill(XRT), second)
    went = suite.send(lighthouse.functions.withdraw(XRT), first)
    (online,) = lighthouse.events.Online().process_receipt(came, errors=DISCARD)
    (offline,) = lighthouse.events.Offline().process_receipt(went, errors=DISCARD)
    (current,) = lighthouse.events.Current().process_receipt(went, errors=DISCARD)
    assert online["args"]["provider"] == second.address
    assert offline["args"]["provider"] == first.address
    assert dict(current["args"]) == {"provider": second.address, "quota": 1}
