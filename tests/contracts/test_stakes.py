"""Stakes, and what coming and leaving do to the turns."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest
from web3.logs import DISCARD

from tests.support.contracts.rounds import TIMEOUT, Round
from tests.support.contracts.suite import XRT

if TYPE_CHECKING:
    from tests.support.contracts.market import Market

pytestmark = pytest.mark.sample("market")


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


@pytest.mark.sample("leaver", "passed")
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


@pytest.mark.sample("passed")
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


@pytest.mark.sample("leaver", "passed")
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
