"""The jury: a validator contract whose jurors judge by a quorum."""

from __future__ import annotations

from itertools import combinations, permutations
from typing import TYPE_CHECKING, Any

import pytest

from schemas import address_bytes, checksum_address, keccak256, parse_cid
from tests.contracts.test_finalization_rules import twins_of
from tests.support.contracts.juries import Panel, ascending, some_people
from tests.support.contracts.market import OTHER, RESULT
from tests.support.contracts.suite import REFUND_DELAY, XRT

if TYPE_CHECKING:
    from tests.support.contracts.market import Market
    from tests.support.contracts.suite import Person

COST = 5 * XRT
FEE = XRT
ZERO = "0x" + "00" * 20


def stand_in(*people: Person) -> str:
    """The address that stands for several signers, as docs of the contracts define it."""
    words = b"".join(bytes(12) + address_bytes(person.address) for person in people)
    return checksum_address(keccak256(words)[12:])


@pytest.fixture
def jury(fifth: Market) -> Panel:
    """A jury of one, the outsider; the deployer keeps it."""
    return Panel(fifth.suite, fifth.outsider)


@pytest.fixture
def panel(fifth: Market) -> Panel:
    """Two of three jurors."""
    return Panel(fifth.suite, quorum=2, size=3)


@pytest.mark.parametrize("success", [True, False])
def test_a_jurors_word_ends_the_work_and_earns_the_fee(fifth: Market, jury: Panel, success: bool) -> None:
    suite = fifth.suite
    liability = fifth.create(cost=COST, validator=jury.address, validator_fee=FEE)
    before = suite.balance(fifth.promisee), suite.balance(fifth.promisor)
    verdict = fifth.result(liability, success=success, by=fifth.outsider)

    suite.send(fifth.finalization(verdict), fifth.provider)

    paid = COST if success else 0
    after = suite.balance(fifth.promisee), suite.balance(fifth.promisor)
    assert after == (before[0] + COST - paid, before[1] + paid)
    assert suite.balance(jury.contract) == FEE
    assert liability.functions.isSuccess().call() == success


def test_only_a_juror_can_judge(fifth: Market, jury: Panel) -> None:
    liability = fifth.create(cost=COST, validator=jury.address)
    for person in (fifth.promisor, fifth.promisee, fifth.suite.deployer):
        refused = fifth.finalization(fifth.result(liability, by=person))
        assert fifth.refusal(refused) == ("RefusedByValidator", person.address)


@pytest.mark.parametrize("success", [True, False])
def test_a_quorum_ends_the_work(fifth: Market, panel: Panel, success: bool) -> None:
    suite = fifth.suite
    for pair in combinations(panel.jurors, 2):
        liability = fifth.create(cost=COST, validator=panel.address, validator_fee=FEE)
        before = suite.balance(fifth.promisor), suite.balance(panel.contract)
        suite.send(fifth.verdict(liability, *pair, success=success), fifth.provider)
        assert liability.functions.isSuccess().call() == success
        after = suite.balance(fifth.promisor), suite.balance(panel.contract)
        assert after == (before[0] + COST * success, before[1] + FEE)


def test_anybody_brings_a_quorums_verdict_without_a_turn(fifth: Market, panel: Panel) -> None:
    liability = fifth.create(cost=COST, validator=panel.address)
    signed = [fifth.result(liability, by=juror) for juror in panel.jurors[1:]]
    signatures = bytes.fromhex("".join(result.signature for result in signed))
    call = fifth.suite.factory.functions.finalize(liability.address, parse_cid(RESULT), True, signatures)
    fifth.suite.send(call, fifth.outsider)
    assert liability.functions.isSuccess().call()


def test_fewer_or_more_than_a_quorum_are_refused(fifth: Market, panel: Panel) -> None:
    liability = fifth.create(cost=COST, validator=panel.address)
    for juror in panel.jurors:
        assert fifth.refusal(fifth.verdict(liability, juror)) == ("RefusedByValidator", juror.address)
    everybody = fifth.verdict(liability, *panel.jurors)
    assert fifth.refusal(everybody) == ("RefusedByValidator", stand_in(*panel.jurors))


def test_a_foreign_signature_completes_no_quorum(fifth: Market, panel: Panel) -> None:
    liability = fifth.create(cost=COST, validator=panel.address)
    for stranger in (fifth.promisor, fifth.outsider):
        for juror in panel.jurors:
            pair = ascending(juror, stranger)
            assert fifth.refusal(fifth.verdict(liability, *pair)) == ("RefusedByValidator", stand_in(*pair))


def test_nobody_counts_twice(fifth: Market, panel: Panel) -> None:
    liability = fifth.create(cost=COST, validator=panel.address)
    for juror in panel.jurors:
        refused = fifth.refusal(fifth.verdict(liability, juror, juror))
        assert refused == ("SignersOutOfOrder", juror.address, juror.address)


def test_signatures_are_in_ascending_order(fifth: Market) -> None:
    panel = Panel(fifth.suite, quorum=3, size=3)
    liability = fifth.create(cost=COST, validator=panel.address)
    for order in list(permutations(panel.jurors))[1:]:
        assert fifth.refusal(fifth.verdict(liability, *order))[0] == "SignersOutOfOrder"
    fifth.suite.send(fifth.verdict(liability, *panel.jurors), fifth.provider)


def test_signatures_of_different_results_make_no_quorum(fifth: Market, panel: Panel) -> None:
    liability = fifth.create(cost=COST, validator=panel.address)
    first, second = panel.jurors[:2]
    paid, refunded = fifth.result(liability, by=first), fifth.result(liability, success=False, by=second)
    for success in (True, False):
        call = fifth.lighthouse.functions.finalizeLiability(
            liability.address, parse_cid(RESULT), success, bytes.fromhex(paid.signature + refunded.signature)
        )
        assert fifth.refusal(call)[0] in ("RefusedByValidator", "SignersOutOfOrder")
    both = bytes.fromhex(paid.signature + fifth.result(liability, by=second).signature)
    altered = fifth.lighthouse.functions.finalizeLiability(liability.address, parse_cid(OTHER), True, both)
    assert fifth.refusal(altered)[0] in ("RefusedByValidator", "SignersOutOfOrder")
    assert not liability.functions.isFinalized().call()


def test_the_twin_of_a_signature_makes_no_second_juror(fifth: Market, panel: Panel) -> None:
    liability = fifth.create(cost=COST, validator=panel.address)
    signed = [bytes.fromhex(fifth.result(liability, by=juror).signature) for juror in panel.jurors[:2]]
    for twin in twins_of(signed[0]):
        for signatures in (twin + signed[1], signed[0] + twin):
            call = fifth.lighthouse.functions.finalizeLiability(liability.address, parse_cid(RESULT), True, signatures)
            assert fifth.refusal(call) == ("InvalidSignature",)


@pytest.mark.parametrize("spoiled", [b"", b"\x1b" * 64, b"\x1b" * 66, b"\x1b" * 131, bytes(130)])
def test_what_is_no_signatures_is_refused(fifth: Market, panel: Panel, spoiled: bytes) -> None:
    liability = fifth.create(cost=COST, validator=panel.address)
    call = fifth.lighthouse.functions.finalizeLiability(liability.address, parse_cid(RESULT), True, spoiled)
    assert fifth.refusal(call) == ("InvalidSignature",)


def test_several_signatures_are_for_validators_alone(fifth: Market) -> None:
    liability = fifth.create(cost=COST)
    pair = ascending(fifth.promisor, fifth.outsider)
    assert fifth.refusal(fifth.verdict(liability, *pair)) == ("InvalidSignature",)


def test_the_third_generation_takes_one_signature(third: Market) -> None:
    panel = Panel(third.suite, quorum=2, size=3)
    liability = third.create(cost=COST, validator=panel.address)
    assert third.refusal(third.verdict(liability, *panel.jurors[:2])) == ("NotTheValidator", third.provider.address)


def test_another_validator_is_asked_about_a_set_like_about_any_signer(fifth: Market) -> None:
    pair = some_people(2)
    accepting = fifth.suite.deploy("OneSigner", stand_in(*pair))
    liability = fifth.create(cost=COST, validator=accepting.address)
    fifth.suite.send(fifth.verdict(liability, *pair), fifth.provider)
    assert accepting.functions.lastAsker().call() == liability.address


@pytest.mark.parametrize(("quorum", "size"), [(1, 1), (1, 7), (2, 2), (3, 5), (4, 7), (7, 7)])
def test_exactly_the_quorums_are_accepted(fifth: Market, quorum: int, size: int) -> None:
    panel = Panel(fifth.suite, quorum=quorum, size=size)
    is_validator = panel.contract.functions.isValidator
    assert panel.contract.functions.quorum().call() == quorum
    assert panel.contract.functions.jurors().call() == [juror.address for juror in panel.jurors]
    for chosen in combinations(panel.jurors, quorum):
        assert is_validator(chosen[0].address if quorum == 1 else stand_in(*chosen)).call()
    for number in {1, quorum - 1, quorum + 1} - {0, quorum}:
        for others in combinations(panel.jurors, number):
            assert not is_validator(stand_in(*others)).call()
    for juror in panel.jurors:
        assert is_validator(juror.address).call() == (quorum == 1)
    assert not is_validator(ZERO).call()


@pytest.mark.parametrize(
    ("jurors", "quorum", "refusal"),
    [
        ([], 1, ("InvalidJurorCount", 0, 7)),
        ([f"0x{number:040x}" for number in range(1, 9)], 1, ("InvalidJurorCount", 8, 7)),
        ([f"0x{1:040x}"], 0, ("InvalidQuorum", 0, 1)),
        ([f"0x{1:040x}"], 2, ("InvalidQuorum", 2, 1)),
        ([f"0x{2:040x}", f"0x{1:040x}"], 1, ("JurorsOutOfOrder", f"0x{2:040x}", f"0x{1:040x}")),
        ([f"0x{2:040x}", f"0x{2:040x}"], 2, ("JurorsOutOfOrder", f"0x{2:040x}", f"0x{2:040x}")),
        ([ZERO, f"0x{1:040x}"], 1, ("JurorsOutOfOrder", ZERO, ZERO)),
    ],
)
def test_what_makes_no_jury_is_refused(fifth: Market, jurors: list[str], quorum: int, refusal: tuple[Any, ...]) -> None:
    assert Panel.refusal(fifth.suite, jurors, quorum) == refusal


def test_jurors_who_disagree_leave_the_refund(fifth: Market, panel: Panel) -> None:
    suite = fifth.suite
    before = suite.balance(fifth.promisee)
    liability = fifth.create(cost=COST, validator=panel.address, validator_fee=FEE)
    suite.chain.mine(REFUND_DELAY)
    suite.send(suite.factory.functions.refund(liability.address))
    assert suite.balance(fifth.promisee) == before
    assert suite.balance(panel.contract) == 0


def test_the_fees_are_the_keepers(fifth: Market, jury: Panel) -> None:
    suite = fifth.suite
    liability = fifth.create(cost=COST, validator=jury.address, validator_fee=FEE)
    suite.send(fifth.finalization(fifth.result(liability, by=fifth.outsider)), fifth.provider)
    before = suite.balance(suite.deployer)

    suite.send(jury.contract.functions.collect(FEE))

    assert suite.balance(suite.deployer) == before + FEE
    assert suite.balance(jury.contract) == 0


def test_only_the_keeper_takes_fees(fifth: Market, jury: Panel) -> None:
    for person in (fifth.promisor, fifth.outsider):
        refused = fifth.refusal(jury.contract.functions.collect(0), person)
        assert refused == ("NotTheKeeper", person.address)


def test_the_originals_ask_a_jury_of_one_as_they_ask_any_validator(fifth: Market, jury: Panel) -> None:
    """The originals call `isValidator(address)` and take its word, 32 bytes that are 0 or 1."""
    web3, selector = fifth.suite.web3, keccak256(b"isValidator(address)")[:4]
    for person, word in ((fifth.outsider, 1), (fifth.promisor, 0)):
        data = selector + bytes(12) + address_bytes(person.address)
        answer = web3.eth.call({"to": jury.address, "data": "0x" + data.hex()})  # type: ignore[typeddict-item]
        assert int.from_bytes(answer) == word
        assert len(answer) == 32
