"""`aira lighthouse`."""

from __future__ import annotations

from itertools import count

import pytest

from mesh.amounts import InvalidAmount
from mesh.chain import XRT
from mesh.chain.errors import UnknownName
from tests.support.cli.served_chain import ServedChain, columns
from tests.support.commands import refused

_numbers = count(1)


@pytest.fixture
def market(served: ServedChain) -> str:
    """A lighthouse of this test's own: two XRT at least, ten blocks."""
    name = f"market-{next(_numbers)}"
    served.ask("provider", lambda chain: chain.lighthouses.create(minimal_stake=2 * XRT, timeout_blocks=10, name=name))
    return name


def test_a_new_lighthouse_is_announced_and_listed(served: ServedChain) -> None:
    made = served.run_json("lighthouse", "create", "brand-new", "--minimal-stake", "2.5", "--timeout-blocks", "7")
    assert (made["name"], made["timeoutBlocks"]) == ("brand-new.lighthouse.3.robonomics.eth", 7)
    listed = served.run_json("lighthouse", "list")
    assert listed[0]["lighthouse"] == served.deployment.lighthouse
    assert listed[-1] == {
        "lighthouse": made["lighthouse"],
        "name": "brand-new",
        "minimalStake": "2500000000",
        "timeoutBlocks": 7,
        "keepAliveBlock": 0,
        "current": None,
        "marker": 0,
        "quota": 0,
        "providers": [],
    }


def test_creating_prints_the_new_lighthouse(served: ServedChain) -> None:
    said = columns(served.aira("lighthouse", "create", "spoken", "--minimal-stake", "5wn").stdout)
    assert said["name"] == "spoken.lighthouse.3.robonomics.eth"
    assert (said["minimal stake"], said["timeout"]) == ("0.000000005 XRT", "25 blocks")


def test_the_list_has_a_line_for_each_since_a_block(served: ServedChain, market: str) -> None:
    head, first, *rest = served.aira("lighthouse", "list").stdout.splitlines()
    assert head.split() == ["NAME", "ADDRESS", "MINIMAL", "STAKE", "TIMEOUT", "PROVIDERS", "STAKED"]
    assert first.split() == ["airalab", served.deployment.lighthouse, "1", "XRT", "5", "blocks", "1", "100", "XRT"]
    assert rest[-1].split()[0] == market
    block = served.ask("person", lambda chain: chain.block_number())
    since = served.aira("lighthouse", "list", "--from-block", str(block)).stdout
    assert [line.split()[0] for line in since.splitlines()] == ["NAME", market]
    done = served.aira("lighthouse", "list", "--from-block", str(block + 1))
    assert done.stdout == f"there is no lighthouse since block {block + 1:,}\n"


def test_joining_approves_the_missing_allowance_and_leaving_returns_the_stake(served: ServedChain, market: str) -> None:
    person = served.people["person"].address
    before = served.ask("person", lambda chain: chain.tokens.balance())
    said = columns(served.aira("lighthouse", "join", market, "5").stdout)
    assert (said["stake"], said["per turn"]) == ("5 XRT", "2 transactions")
    assert served.ask("person", lambda chain: chain.tokens.balance()) == before - 5 * XRT
    more = served.run_json("lighthouse", "join", market, "1000000000wn")
    assert (more["stake"], more["quota"], more["isProvider"]) == (str(6 * XRT), 3, True)
    less = served.run_json("lighthouse", "leave", market, "2")
    assert (less["provider"], less["stake"], less["quota"]) == (person, str(4 * XRT), 2)
    said = columns(served.aira("lighthouse", "leave", market).stdout)
    assert said["stake"] == "0 XRT"
    assert said["provider"] == f"{person}  (no longer a provider)"
    assert served.ask("person", lambda chain: chain.tokens.balance()) == before


def test_a_withdrawal_that_leaves_less_than_the_minimum_takes_everything(served: ServedChain, market: str) -> None:
    served.run_json("lighthouse", "join", market, "3")
    printed = served.run_json("lighthouse", "leave", market, "2")
    assert (printed["stake"], printed["isProvider"]) == ("0", False)


def test_info_shows_providers_and_whose_turn_it_is(served: ServedChain, market: str) -> None:
    people = [served.people[role].address for role in ("robot", "person")]
    for role, stake in (("robot", "4"), ("person", "10")):
        served.run_json("lighthouse", "join", market, stake, by=role)
    printed = served.run_json("lighthouse", "info", market)
    assert [provider["provider"] for provider in printed["providers"]] == people
    assert [provider["quota"] for provider in printed["providers"]] == [2, 5]
    assert (printed["current"], printed["marker"], printed["quota"]) == (people[0], 1, 2)
    assert [provider["maySend"] for provider in printed["providers"]] == [True, False]
    said = served.aira("lighthouse", "info", market).stdout
    assert columns(said)["turn"] == f"{people[0]}  (1 of 2), 2 transactions left"
    lines = [line.split() for line in said.splitlines()[-2:]]
    assert lines == [
        ["1", people[0], "4", "XRT", "2", "transactions", "yes"],
        ["2", people[1], "10", "XRT", "5", "transactions", "no"],
    ]
    served.mine(25)
    assert [provider["maySend"] for provider in served.run_json("lighthouse", "info", market)["providers"]] == [
        True,
        True,
    ]


def test_info_is_by_default_of_the_settings_lighthouse(served: ServedChain) -> None:
    said = columns(served.aira("lighthouse", "info").stdout)
    assert (said["lighthouse"], said["name"]) == (served.deployment.lighthouse, "airalab.lighthouse.3.robonomics.eth")
    assert said["minimal stake"] == "1 XRT"


def test_info_of_an_empty_lighthouse_shows_how_to_join(served: ServedChain, market: str) -> None:
    assert "aira lighthouse join" in columns(served.aira("lighthouse", "info", market).stdout)["providers"]


def test_a_taken_name_is_one_clear_line(served: ServedChain) -> None:
    done = served.aira("lighthouse", "create", "airalab")
    assert refused(done, "name-taken", "airalab.lighthouse.3.robonomics.eth") == "choose another name"


@pytest.mark.parametrize("name", ["Airalab", "a b", "a.b", "", "a" * 33])
def test_an_invalid_name_is_one_clear_line(served: ServedChain, name: str) -> None:
    refused(served.aira("lighthouse", "create", name), "invalid-lighthouse", repr(name))


@pytest.mark.parametrize("stake", ["0", "0wn", str(2**128) + "wn"])
def test_an_invalid_minimal_stake_is_one_clear_line(served: ServedChain, stake: str) -> None:
    refused(served.aira("lighthouse", "create", "staked", "--minimal-stake", stake), "invalid-lighthouse")


def test_a_stake_below_the_minimum_is_one_clear_line(served: ServedChain, market: str) -> None:
    hint = refused(served.aira("lighthouse", "join", market, "1.5"), "invalid-stake", "1.5 XRT", "2 XRT")
    assert hint == "stake 2 XRT or more"
    refused(served.aira("lighthouse", "join", market, "0"), "invalid-stake")


def test_a_stake_beyond_the_balance_is_one_clear_line(served: ServedChain, market: str) -> None:
    refused(served.aira("lighthouse", "join", market, "3", by="stranger"), "balance-too-low", "0 XRT", "3 XRT")


def test_leaving_without_a_stake_is_one_clear_line(served: ServedChain, market: str) -> None:
    refused(served.aira("lighthouse", "leave", market), "not-a-provider", market)


def test_a_withdrawal_of_more_than_the_stake_is_one_clear_line(served: ServedChain, market: str) -> None:
    served.run_json("lighthouse", "join", market, "3")
    refused(served.aira("lighthouse", "leave", market, "3.5"), "invalid-stake", "3.5 XRT", "3 XRT")


def test_an_unknown_lighthouse_is_one_clear_line(served: ServedChain) -> None:
    for command in (("info", "nowhere"), ("join", "nowhere", "1"), ("leave", "nowhere")):
        refused(served.aira("lighthouse", *command), UnknownName, "nowhere.lighthouse.3.robonomics.eth")


def test_an_address_without_a_lighthouse_is_one_clear_line(served: ServedChain) -> None:
    address = served.deployment.xrt
    for command in (("info", address), ("join", address, "1"), ("leave", address)):
        refused(served.aira("lighthouse", *command), "not-a-lighthouse", address)


def test_the_default_lighthouse_to_join_and_leave_is_that_of_the_settings(served: ServedChain, market: str) -> None:
    at = ("--lighthouse-contract", market)
    assert served.run_json("lighthouse", "join", "4", *at)["name"] == market
    assert served.run_json("lighthouse", "leave", "2", *at)["stake"] == str(2 * XRT)
    assert served.run_json("lighthouse", "leave", *at)["stake"] == "0"


def test_misplaced_arguments_are_one_clear_line(served: ServedChain, market: str) -> None:
    hint = refused(served.aira("lighthouse", "join", "20", market), InvalidAmount, market)
    assert hint == f"the lighthouse comes first: {market} 20"
    assert f"join {market} 20" in refused(served.aira("lighthouse", "join", market), "invalid-options", "VALUE")
    refused(served.aira("lighthouse", "join", market, "much"), InvalidAmount, "much")
    refused(served.aira("lighthouse", "leave", market, "1", "2"), "invalid-options")
