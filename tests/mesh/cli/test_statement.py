"""`aira statement`: earnings and costs of an account, as a table, as CSV and as JSON."""

from __future__ import annotations

import csv
import io
from datetime import UTC, datetime, timedelta
from decimal import Decimal
from typing import TYPE_CHECKING, Any

import pytest

from mesh.chain import XRT, DeploymentPlan, TransactionSender
from mesh.errors import InputError
from tests.support.cli.served_chain import REFUND_DELAY, ServedChain
from tests.support.commands import refused

if TYPE_CHECKING:
    from collections.abc import Iterator

COST = 1_234_567_890_123
FORMULA = b"=A1"
"""The symbol of a token, as a spreadsheet understands it."""


@pytest.fixture
def fresh(tmp_path: Any) -> Iterator[ServedChain]:
    """A served chain without contracts of other tests."""
    plan = DeploymentPlan(refund_delay=REFUND_DELAY, timeout_blocks=5)
    with ServedChain(tmp_path, plan=plan) as served:
        yield served


def rows_of(text: str) -> list[dict[str, str]]:
    return list(csv.DictReader(io.StringIO(text)))


def header(served: ServedChain, number: int) -> Any:
    return served.ask("person", lambda chain: chain.node.header(number))


def first_block_since(served: ServedChain, moment: int) -> int:
    return served.ask("person", lambda chain: chain.node.first_block_since(moment))


def gas_of(served: ServedChain, tx: str) -> int:
    """What the gas of a transaction cost, wei, as its receipt says."""

    async def cost() -> int:
        async with served.chain("person") as chain:
            receipt = await chain.node.receipt(tx)
            assert receipt is not None
            assert receipt.effective_gas_price is not None
            return receipt.gas_used * receipt.effective_gas_price

    return served.run(cost())


def token_with_a_formula(served: ServedChain) -> str:
    """The address of a token, XRT in all but its symbol, of which the person has all."""

    async def deployed() -> str:
        async with served.chain("person") as chain:
            assert chain.account is not None
            data = chain.node.creation_code("XRT", 10**18)
            assert data.count(b"XRT") >= 1
            sender = TransactionSender(chain.node, chain.account)
            receipt = await sender.send(to=None, data=data.replace(b"XRT", FORMULA))
            assert receipt.contract is not None
            await chain.tokens.approve(chain.factory, 10**18, token=receipt.contract)
            return receipt.contract

    return served.run(deployed())


def test_each_contract_has_its_amounts_blocks_and_gas(fresh: ServedChain) -> None:
    person, robot = fresh.people["person"].address, fresh.people["robot"].address
    paid = fresh.create_liability(cost=COST % XRT, lighthouse_fee=7)
    recording = fresh.finalize(paid)
    failed = fresh.create_liability(cost=3 * XRT)
    fresh.finalize(failed, success=False)
    opened = fresh.create_liability(cost=5 * XRT)
    head = fresh.ask("person", lambda chain: chain.block_number())

    earned, lost, waiting = fresh.run_json("statement", by="robot")["contracts"]

    made, ended = header(fresh, head - 4), header(fresh, head - 3)
    steps = ["0x" + block.transactions[0].hex() for block in (made, ended)]
    assert datetime.fromisoformat(earned.pop("time")).timestamp() == ended.timestamp
    assert earned.pop("month") == datetime.now(UTC).strftime("%Y-%m")
    assert earned == {
        "block": head - 3,
        "liability": paid,
        "state": "paid",
        "promisee": person,
        "promisor": robot,
        "model": fresh.ask("person", lambda chain: chain.liabilities.get(paid)).model,
        "token": fresh.deployment.xrt,
        "symbol": "XRT",
        "decimals": 9,
        "cost": str(COST % XRT),
        "earned": str(COST % XRT),
        "spent": "0",
        "fee": "7",
        "gas": str(sum(gas_of(fresh, tx) for tx in steps)),
        "ownGas": "0",
        "tx": steps[1],
        "result": recording,
    }
    assert (lost["liability"], lost["state"], lost["earned"], lost["block"]) == (failed, "failed", "0", head - 1)
    assert (waiting["liability"], waiting["state"], waiting["earned"], waiting["block"]) == (opened, "open", "0", head)
    assert fresh.run_json("statement", by="person")["contracts"][0]["spent"] == str(COST % XRT)
    assert fresh.run_json("statement", by="stranger") == {
        "account": fresh.people["stranger"].address,
        "contracts": [],
        "sums": [],
    }


def test_gas_that_the_account_itself_paid_is_its_own(fresh: ServedChain) -> None:
    address = fresh.create_liability(cost=XRT)
    fresh.mine(REFUND_DELAY)
    fresh.run_json("liability", "cancel", address, "--refund", by="person")

    contract = fresh.run_json("statement", by="person")["contracts"][0]

    assert contract["state"] == "called-off"
    assert contract["ownGas"] == str(gas_of(fresh, contract["tx"]))
    assert int(contract["gas"]) > int(contract["ownGas"]) > 0
    assert fresh.run_json("statement", by="robot")["contracts"][0]["ownGas"] == "0"


def test_csv_has_exact_decimals_and_the_sums_are_those_of_its_rows(fresh: ServedChain) -> None:
    costs = [COST, 1, 10**9 * XRT // 10_000_000 + 1]
    for cost in costs:
        fresh.finalize(fresh.create_liability(cost=cost % (300 * XRT)))
    rows = rows_of(fresh.aira("statement", "--csv", by="robot").stdout)
    [total] = rows_of(fresh.aira("statement", "--csv", "--sums", by="robot").stdout)

    assert [Decimal(row["earned"]) * XRT for row in rows] == [cost % (300 * XRT) for cost in costs]
    assert rows[1]["earned"] == "0.000000001"
    assert all("," not in value and "e" not in row["earned"].lower() for row in rows for value in row.values())
    assert (total["contracts"], total["paid"]) == ("3", "3")
    for name in ("earned", "spent", "fee (XRT)", "gas (ETH)", "own gas (ETH)"):
        assert Decimal(total[name]) == sum(Decimal(row[name]) for row in rows)
    assert Decimal(total["gas (ETH)"]) > 0


def test_a_symbol_that_is_a_formula_is_text_in_csv(fresh: ServedChain) -> None:
    token = token_with_a_formula(fresh)
    fresh.finalize(fresh.create_liability(cost=7, token=token))
    done = fresh.aira("statement", "--csv", by="robot")
    [row] = rows_of(done.stdout)
    assert (row["symbol"], row["token"]) == (f"'=A1 ({token[:6]}…{token[-4:]})", token)
    assert not any(
        cell.startswith(("=", "+", "-", "@")) for line in done.stdout.splitlines() for cell in line.split(",")
    )
    said = fresh.aira("statement", by="robot").stdout
    assert f"0.000000007 =A1 ({token[:6]}…{token[-4:]})" in said


def test_tokens_are_never_added_up_with_others(fresh: ServedChain) -> None:
    token = token_with_a_formula(fresh)
    fresh.finalize(fresh.create_liability(cost=7, token=token))
    fresh.finalize(fresh.create_liability(cost=9))
    sums = fresh.run_json("statement", by="robot")["sums"]
    assert {one["token"]: one["earned"] for one in sums} == {token: "7", fresh.deployment.xrt: "9"}


def test_a_period_includes_its_first_and_its_last_day(served: ServedChain) -> None:
    address = served.create_liability(cost=XRT)
    served.finalize(address)
    ended = datetime.fromisoformat(served.run_json("statement")["contracts"][-1]["time"])
    today, yesterday, tomorrow = (f"{ended + timedelta(days):%Y-%m-%d}" for days in (0, -1, 1))

    def is_in(*options: str) -> bool:
        found = served.run_json("statement", *options)["contracts"]
        return address in [one["liability"] for one in found]

    for inside in (("--from", today), ("--to", today), ("--from", today, "--to", today), ("--from", today[:7])):
        assert is_in(*inside)
    for outside in (("--to", yesterday), ("--from", tomorrow)):
        assert not is_in(*outside)
    assert rows_of(served.aira("statement", "--csv", "--from", tomorrow).stdout) == []
    assert served.aira("statement", "--from", tomorrow).stdout.startswith("no contracts of 0x")


def test_a_contract_that_ended_in_the_period_is_found_although_it_was_created_before(served: ServedChain) -> None:
    address = served.create_liability(cost=XRT)
    served.mine(20)
    served.finalize(address)

    async def history(block: int) -> list[tuple[str, int]]:
        async with served.chain("person") as chain:
            found = await chain.liabilities.history(from_block=block)
            return [(one.liability.address, one.created.block_number) for one in found]

    head = served.ask("person", lambda chain: chain.block_number())
    assert served.run(history(head)) == [(address, head - 21)]
    assert served.run(history(head + 1)) == []


def test_the_first_block_of_a_time_is_found(served: ServedChain) -> None:
    served.mine(7)
    head = served.ask("person", lambda chain: chain.block_number())
    times = [header(served, number).timestamp for number in range(head + 1)]
    for number in (0, 1, head // 2, head):
        assert first_block_since(served, times[number]) == times.index(times[number])
    assert first_block_since(served, times[-1] + 1) == head + 1


@pytest.mark.parametrize(
    "dates", [("--from", "28.11.2026"), ("--from", "2026-02", "--to", "2026-01"), ("--to", "2026-13")]
)
def test_a_wrong_date_is_one_clear_line(served: ServedChain, dates: tuple[str, ...]) -> None:
    refused(served.aira("statement", *dates), InputError, dates[-1])


def test_two_formats_at_once_are_refused(served: ServedChain) -> None:
    assert served.aira("statement", "--csv", "--json").exit_code == 2
