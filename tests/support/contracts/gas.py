"""Gas of the contracts' transactions, and the bars that it stays below.

Measured on py-evm with nonces that were used before, a quota above one, balances above zero (the factory's too, from a
liability that is still open) and approvals that are used up bit by bit.
"""

from __future__ import annotations

from typing import Final, NamedTuple

from schemas import parse_cid
from tests.support.contracts.chains import py_evm
from tests.support.contracts.juries import Panel
from tests.support.contracts.market import FUNDS, RESULT, Market
from tests.support.contracts.suite import REFUND_DELAY, XRT, Suite

Gas = dict[str, dict[str, int]]
"""Gas by row and generation (`generation_5`, `generation_3`)."""

GENERATIONS: Final = {5: "generation_5", 3: "generation_3"}


class Row(NamedTuple):
    """A row of the table; a pair is generation 5, generation 3. A reverted original took what it was given.

    `-` is what the originals can't do, or what was not measured; a bar of None is what a generation can't do.
    """

    label: str
    originals: tuple[str, str]
    bars: tuple[int, int | None]


ROWS: Final = {
    "create_lighthouse": Row("createLighthouse", ("274,737", "447,535"), (185_000, 185_000)),
    "create_cost_0": Row("createLiability, cost 0", ("796,277", "809,155"), (145_000, 190_000)),
    "create_cost": Row("createLiability, cost > 0", ("858,781", "870,450"), (165_000, 212_000)),
    "create_cost_fee": Row("  + lighthouseFee", ("901,585", "914,228"), (185_000, 232_000)),
    "create_permit": Row("  with a permit", ("-", "-"), (178_000, 222_000)),
    "create_permit_fee": Row("  and a fee for it", ("-", "-"), (212_000, 255_000)),
    "create_validator": Row("  + validator, no fees", ("-", "-"), (175_000, 220_000)),
    "finalize_cost_0": Row("finalize, cost 0", ("268,656", "214,894"), (102_000, 102_000)),
    "finalize_cost": Row("finalize, cost > 0", ("279,670", "226,793"), (115_000, 115_000)),
    "finalize_1_juror": Row("  by a validator", ("-", "-"), (120_000, 115_000)),
    "finalize_2_of_3": Row("  by 2 of 3 jurors", ("-", "-"), (125_000, None)),
    "finalize_4_of_7": Row("  by 4 of 7 jurors", ("-", "-"), (150_000, None)),
    "finalize_token": Row("  in a foreign token", ("-", "-"), (110_000, 110_000)),
    "finalize_owed": Row("  that refuses to pay", ("-", "-"), (125_000, 125_000)),
    "claim": Row("claim what is owed", ("-", "-"), (50_000, 50_000)),
    "deploy_jury": Row("deploy 2 of 3 jurors", ("-", "-"), (600_000, None)),
    "approve": Row("approve the factory", ("-", "-"), (50_000, 50_000)),
    "refund": Row("refund, cost > 0", ("-", "-"), (85_000, 85_000)),
    "withdraw_order": Row("withdraw an order", ("-", "-"), (35_000, 50_000)),
    "revert_mismatch": Row("reverted create (mismatch)", ("the limit", "~700,000"), (60_000, 60_000)),
}


def measure() -> Gas:
    """Gas used by each kind of transaction, in both generations."""
    gas: Gas = {key: {} for key in ROWS}
    for generation, column in GENERATIONS.items():
        for key, used in _measure(Market(Suite(py_evm()), generation)).items():
            gas[key][column] = used
    return gas


def _measure(market: Market) -> dict[str, int]:
    suite = market.suite
    warm = market.create(cost=XRT, lighthouse_fee=XRT)
    market.finalize(warm)
    market.create(cost=XRT)

    used = {}
    lighthouse = suite.factory.functions.createLighthouse(XRT, 10, "another")
    used["create_lighthouse"] = suite.send(lighthouse)["gasUsed"]
    for ending, terms in (("cost_0", {}), ("cost", {"cost": XRT}), ("cost_fee", {"cost": XRT, "lighthouse_fee": XRT})):
        created = suite.send(market.creation(*market.pair(**terms)), market.provider)
        used[f"create_{ending}"] = created["gasUsed"]
        used[f"finalize_{ending}"] = market.finalize(market.liability_of(created))["gasUsed"]
    used |= _measure_permits(market)
    used |= _measure_validator(market)
    used |= _measure_foreign_token(market)
    used["withdraw_order"] = suite.send(market.withdrawal(market.demand()), market.promisee)["gasUsed"]
    mismatch = market.creation(market.demand(cost=XRT), market.offer(cost=2 * XRT))
    used["revert_mismatch"] = suite.attempt(mismatch, market.provider)["gasUsed"]
    used["approve"] = suite.send(suite.xrt.functions.approve(market.outsider.address, 2 * XRT), market.promisee)[
        "gasUsed"
    ]
    liability = market.create(cost=XRT)
    suite.chain.mine(REFUND_DELAY)
    used["refund"] = suite.send(suite.factory.functions.refund(liability.address), market.promisee)["gasUsed"]
    return {key: used[key] for key in ROWS if key in used}


def _measure_permits(market: Market) -> dict[str, int]:
    """Of a promisee without an allowance, whose nonce is used already."""
    suite, used = market.suite, {}
    nobody = suite.xrt.functions.approve(suite.factory.address, 0)
    suite.send(nobody, market.promisee)
    suite.send(market.permission(market.permit(0)))
    for key, fee in (("create_permit", 0), ("create_permit_fee", XRT)):
        orders, permit = market.pair(cost=XRT, validator_fee=fee), market.permit(XRT + fee)
        used[key] = suite.send(market.permitted_creation(*orders, permit), market.provider)["gasUsed"]
    suite.send(suite.xrt.functions.approve(suite.factory.address, FUNDS), market.promisee)
    return used


def _measure_validator(market: Market) -> dict[str, int]:
    suite, used = market.suite, {}
    if market.generation == 3:
        created = suite.send(
            market.creation(*market.pair(cost=XRT, validator=market.outsider.address)), market.provider
        )
        liability = market.liability_of(created)
        data, signature = parse_cid(RESULT), bytes.fromhex(market.result(liability).signature)
        verdict = liability.functions.finalize(data, True, signature, True)
        finalized = suite.send(verdict, market.outsider)
        return {"create_validator": created["gasUsed"], "finalize_1_juror": finalized["gasUsed"]}
    for key, quorum, size in (("1_juror", 1, 1), ("4_of_7", 4, 7), ("2_of_3", 2, 3)):
        jury = Panel(suite, quorum=quorum, size=size)
        created = suite.send(market.creation(*market.pair(cost=XRT, validator=jury.address)), market.provider)
        # The last of the sets that the contract looks through.
        verdict = market.verdict(market.liability_of(created), *jury.jurors[-quorum:])
        used[f"finalize_{key}"] = suite.send(verdict, market.provider)["gasUsed"]
    return {**used, "create_validator": created["gasUsed"], "deploy_jury": jury.gas}


def _measure_foreign_token(market: Market) -> dict[str, int]:
    suite, paid = market.suite, 5
    token = suite.deploy("BlockingToken", 10 * paid)
    suite.send(token.functions.transfer(market.promisee.address, 9 * paid))
    suite.send(token.functions.transfer(market.promisor.address, 1))
    terms = {"token": token.address, "cost": paid}
    waiting, liability, refused = (market.create(**terms) for _ in range(3))
    used = {"finalize_token": market.finalize(liability)["gasUsed"]}
    suite.send(token.functions.setBlocked(market.promisor.address, True))
    used["finalize_owed"] = market.finalize(refused)["gasUsed"]
    suite.send(token.functions.setBlocked(market.promisor.address, False))
    claim = suite.factory.functions.claim(token.address, market.promisor.address)
    used["claim"] = suite.send(claim, market.outsider)["gasUsed"]
    assert not waiting.functions.isFinalized().call()
    return used


def exceeded(gas: Gas) -> list[str]:
    """One line for each measurement above its bar."""
    return [
        f"{key}, {column}: {gas[key][column]:,} is above the bar of {bar:,}"
        for key, row in ROWS.items()
        for column, bar in zip(GENERATIONS.values(), row.bars, strict=True)
        if bar is not None and gas[key][column] > bar
    ]
