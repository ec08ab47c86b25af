"""What does not end a liability, and the reason it gives."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import pytest
from msgspec.structs import replace

from schemas import Result, parse_cid
from tests.support.contracts.market import OTHER
from tests.support.contracts.suite import REFUND_DELAY, XRT

if TYPE_CHECKING:
    from web3.contract import Contract

    from tests.support.contracts.market import Market

pytestmark = pytest.mark.sample("market")

SOMEBODY = "0x" + "42" * 20
CURVE_ORDER = 0xFFFFFFFFFFFFFFFFFFFFFFFFFFFFFFFEBAAEDCE6AF48A03BBFD25E8CD0364141


def twins_of(signature: bytes) -> list[bytes]:
    """Other bytes that some recover the same signer from, and bytes that nobody has signed."""
    mirrored = (CURVE_ORDER - int.from_bytes(signature[32:64], "big")).to_bytes(32, "big")
    return [
        signature[:32] + mirrored + bytes((55 - signature[64],)),
        signature[:64] + bytes((signature[64] - 27,)),
        bytes(32) + signature[32:],
    ]


@pytest.fixture
def liability(market: Market) -> Contract:
    """A liability that costs something."""
    return market.create(cost=XRT)


def test_only_the_promisors_result_counts(market: Market, liability: Contract) -> None:
    for person in (market.promisee, market.provider, market.outsider):
        refusal = market.refusal(market.finalization(market.result(liability, by=person)))
        assert refusal == ("WrongSigner", market.promisor.address, person.address)


@pytest.mark.parametrize("change", [{"result": OTHER}, {"success": False}])
def test_an_altered_result_is_refused(market: Market, liability: Contract, change: dict[str, Any]) -> None:
    result = replace(market.result(liability), **change)
    assert market.refusal(market.finalization(result))[:2] == ("WrongSigner", market.promisor.address)


def test_a_result_is_for_its_liability_alone(market: Market, liability: Contract) -> None:
    other = market.create(cost=XRT)
    result = replace(market.result(liability), liability=other.address)
    assert market.refusal(market.finalization(result))[:2] == ("WrongSigner", market.promisor.address)


def test_the_twins_of_a_signature_are_refused(market: Market, liability: Contract) -> None:
    result = market.result(liability)
    for twin in twins_of(bytes.fromhex(result.signature)):
        refusal = market.refusal(market.finalization(replace(result, signature=twin.hex())))
        assert refusal == ("InvalidSignature",)


@pytest.mark.parametrize("again", [True, False])
def test_a_liability_ends_once(market: Market, liability: Contract, again: bool) -> None:
    market.finalize(liability)
    second = market.finalization(market.result(liability, success=again))
    assert market.refusal(second) == ("AlreadyFinalized", liability.address)


def test_a_refunded_liability_stays_refunded(market: Market, liability: Contract) -> None:
    suite = market.suite
    suite.chain.mine(REFUND_DELAY)
    refund = suite.factory.functions.refund(liability.address)
    suite.send(refund)
    assert market.refusal(refund) == ("AlreadyFinalized", liability.address)
    assert market.refusal(market.finalization(market.result(liability))) == ("AlreadyFinalized", liability.address)


def test_an_early_refund_is_refused(market: Market, liability: Contract) -> None:
    created = liability.functions.createdAt().call()
    refund = market.suite.factory.functions.refund(liability.address)
    assert market.refusal(refund) == ("RefundTooEarly", created + REFUND_DELAY)


def test_only_liabilities_of_the_factory_can_end(market: Market, liability: Contract) -> None:
    suite = market.suite
    signature = bytes(65).hex()
    for address in (SOMEBODY, market.lighthouse.address, suite.xrt.address, suite.implementation(liability)):
        result = Result(liability=address, result=OTHER, success=True, signature=signature)
        assert market.refusal(market.finalization(result)) == ("NotALiability", result.liability)
        assert market.refusal(suite.factory.functions.refund(result.liability)) == ("NotALiability", result.liability)


def test_another_lighthouse_cannot_end_it(market: Market, liability: Contract) -> None:
    suite = market.suite
    other = suite.create_lighthouse(name="other")
    suite.join(other, market.outsider, XRT)
    call = market.finalization(market.result(liability), other)
    assert market.refusal(call, market.outsider) == ("WrongLighthouse", market.lighthouse.address, other.address)


def test_the_factory_and_the_liability_take_no_results_from_outsiders(market: Market, liability: Contract) -> None:
    result = market.result(liability)
    data, signature = parse_cid(result.result), bytes.fromhex(result.signature)
    outsider = market.outsider.address
    functions = market.suite.factory.functions
    direct = functions.finalizeLiability(liability.address, data, True, signature)
    assert market.refusal(direct, market.outsider) == ("WrongLighthouse", market.lighthouse.address, outsider)
    judged = functions.finalizeByValidator(outsider, data, True, signature, True)
    assert market.refusal(judged, market.outsider) == ("NotALiability", outsider)
    verdict = liability.functions.finalize(data, True, signature, True)
    assert market.refusal(verdict, market.outsider) == ("NotTheValidator", outsider)
    for settle in (
        liability.functions.settleByFactory(data[2:], True),
        liability.functions.askValidator(SOMEBODY, SOMEBODY),
    ):
        assert market.refusal(settle, market.outsider) == ("NotTheFactory", outsider)


@pytest.mark.parametrize(
    ("result", "signature", "reason"),
    [
        (b"", bytes(65), "MalformedResult"),
        (parse_cid(OTHER)[:-1], bytes(65), "MalformedResult"),
        (parse_cid(OTHER) + b"\0", bytes(65), "MalformedResult"),
        (b"\x12\x21" + parse_cid(OTHER)[2:], bytes(65), "MalformedResult"),
        (b"\x12\x20" + bytes(32), bytes(65), "MalformedResult"),
        (b"\x12\x20" + bytes(31) + b"\1", bytes(65), "MalformedResult"),
        (parse_cid(OTHER), b"", "InvalidSignature"),
        (parse_cid(OTHER), bytes(64), "InvalidSignature"),
        (parse_cid(OTHER), bytes(66), "InvalidSignature"),
    ],
)
def test_bytes_that_are_not_a_result_are_refused(
    market: Market, liability: Contract, result: bytes, signature: bytes, reason: str
) -> None:
    call = market.lighthouse.functions.finalizeLiability(liability.address, result, True, signature)
    assert market.refusal(call) == (reason,)


def test_to_forwards_only_finalize(market: Market, liability: Contract) -> None:
    suite, to = market.suite, market.lighthouse.functions.to
    theft = suite.xrt.encode_abi("transfer", [market.provider.address, XRT])
    for target, data in ((suite.xrt.address, theft), (liability.address, b""), (liability.address, b"\xc5\x21\x3e")):
        assert market.refusal(to(target, data)) == ("OnlyFinalize",)


@pytest.mark.parametrize("size", [4, 35, 355, 357])
def test_to_refuses_arguments_of_another_shape(market: Market, liability: Contract, size: int) -> None:
    result = market.result(liability)
    arguments = [parse_cid(result.result), True, bytes.fromhex(result.signature), True]
    carried = bytes.fromhex(liability.encode_abi("finalize", arguments)[2:])
    data = (carried + bytes(1))[:size]
    assert market.refusal(market.lighthouse.functions.to(liability.address, data)) == ("MalformedResult",)
    assert market.refusal(market.lighthouse.functions.to(liability.address, carried)) == ()
