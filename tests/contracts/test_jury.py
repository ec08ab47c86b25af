"""The sample validator: a contract with jurors."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest
from web3.logs import DISCARD

from tests.contracts.suite import XRT

if TYPE_CHECKING:
    from web3.contract import Contract

    from tests.contracts.market import Market

COST = 5 * XRT
FEE = XRT


@pytest.fixture
def jury(fifth: Market) -> Contract:
    """A jury of one, the outsider; the deployer keeps it."""
    contract = fifth.suite.deploy("Jury", fifth.suite.xrt.address)
    fifth.suite.send(contract.functions.name(fifth.outsider.address, True))
    return contract


@pytest.mark.parametrize("success", [True, False])
def test_a_jurors_word_ends_the_work_and_earns_the_fee(fifth: Market, jury: Contract, success: bool) -> None:
    suite = fifth.suite
    liability = fifth.create(cost=COST, validator=jury.address, validator_fee=FEE)
    before = suite.balance(fifth.promisee), suite.balance(fifth.promisor)
    verdict = fifth.result(liability, success=success, by=fifth.outsider)

    suite.send(fifth.finalization(verdict), fifth.provider)

    paid = COST if success else 0
    after = suite.balance(fifth.promisee), suite.balance(fifth.promisor)
    assert after == (before[0] + COST - paid, before[1] + paid)
    assert suite.balance(jury) == FEE
    assert liability.functions.isSuccess().call() == success


def test_only_a_juror_can_judge(fifth: Market, jury: Contract) -> None:
    liability = fifth.create(cost=COST, validator=jury.address)
    for person in (fifth.promisor, fifth.promisee, fifth.suite.deployer):
        refused = fifth.finalization(fifth.result(liability, by=person))
        assert fifth.refusal(refused) == ("RefusedByValidator", person.address)


def test_a_dismissed_juror_can_not_judge(fifth: Market, jury: Contract) -> None:
    liability = fifth.create(cost=COST, validator=jury.address)
    receipt = fifth.suite.send(jury.functions.name(fifth.outsider.address, False))
    (event,) = jury.events.Named().process_receipt(receipt, errors=DISCARD)
    assert dict(event["args"]) == {"juror": fifth.outsider.address, "serves": False}
    refused = fifth.finalization(fifth.result(liability, by=fifth.outsider))
    assert fifth.refusal(refused) == ("RefusedByValidator", fifth.outsider.address)


def test_the_fees_are_the_keepers(fifth: Market, jury: Contract) -> None:
    suite = fifth.suite
    liability = fifth.create(cost=COST, validator=jury.address, validator_fee=FEE)
    suite.send(fifth.finalization(fifth.result(liability, by=fifth.outsider)), fifth.provider)
    before = suite.balance(suite.deployer)

    suite.send(jury.functions.collect(FEE))

    assert suite.balance(suite.deployer) == before + FEE
    assert suite.balance(jury) == 0


def test_only_the_keeper_names_jurors_and_takes_fees(fifth: Market, jury: Contract) -> None:
    before = jury.functions.isValidator(fifth.promisor.address).call()
    calls = (jury.functions.name(fifth.promisor.address, True), jury.functions.collect(0))
    for call in calls:
        receipt = fifth.suite.attempt(call, fifth.promisor)
        assert receipt["status"] == 0
    assert not before
    assert not jury.functions.isValidator(fifth.promisor.address).call()
