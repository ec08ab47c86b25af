"""`aira chain cost`."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING

import pytest

from mesh.amounts import InvalidAmount
from mesh.cli.chain import EACH_JOB, STEPS
from mesh.settings.chains import CHAINS
from tests.support.cli.served_chain import ServedChain
from tests.support.commands import invoke, refused

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

STATED = ("--gas-price", "0.01", "--coin-price", "3000")


@pytest.fixture
def served(tmp_path: Path) -> Iterator[ServedChain]:
    with ServedChain(tmp_path, is_deployed=False) as place:
        yield place


@pytest.mark.parametrize("chain", CHAINS)
def test_a_job_has_a_price_in_the_coin_of_each_chain_and_in_money(chain: str) -> None:
    facts = json.loads(invoke("chain", "cost", "--chain", chain, *STATED, "--json").stdout)
    gas = sum(step.gas_in(3) for step in STEPS[:EACH_JOB])
    assert (facts["chain"], facts["coin"], facts["coinPrice"]) == (chain, CHAINS[chain].coin, 3000.0)
    assert (facts["job"]["gas"], facts["job"]["wei"]) == (gas, str(gas * 10**7))
    assert facts["job"]["usd"] == pytest.approx(gas * 1e-11 * 3000, abs=1e-6)
    shown = invoke("chain", "cost", "--chain", chain, *STATED).stdout
    assert CHAINS[chain].title in shown
    assert ("not counted" in shown) == (CHAINS[chain].l1 == "op")


def test_the_price_of_gas_is_the_nodes(served: ServedChain) -> None:
    facts = served.run_json("chain", "cost", "--generation", "5")
    assert int(facts["gasPrice"]) > 0
    assert facts["job"]["gas"] == sum(step.gas_in(5) for step in STEPS[:EACH_JOB])
    assert int(facts["job"]["wei"]) == facts["job"]["gas"] * int(facts["gasPrice"])
    assert "usd" not in facts["job"]
    assert [one["step"] for one in facts["steps"]] == [step.name for step in STEPS]


def test_a_price_that_is_none_is_refused() -> None:
    refused(invoke("chain", "cost", "--gas-price", "cheap"), InvalidAmount)
