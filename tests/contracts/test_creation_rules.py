"""What the factory refuses to make a liability of, and the reason it gives."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import pytest
from eth_abi.abi import encode
from msgspec.structs import replace

from schemas import ZERO_ADDRESS, keccak256, message_hash, order_abi
from tests.support.contracts.market import FUNDS, OTHER
from tests.support.contracts.suite import XRT

if TYPE_CHECKING:
    from collections.abc import Callable

    from tests.support.contracts.market import Market

pytestmark = pytest.mark.sample("market")

SOMEBODY = "0x" + "42" * 20
CURVE_ORDER = 0xFFFFFFFFFFFFFFFFFFFFFFFFFFFFFFFEBAAEDCE6AF48A03BBFD25E8CD0364141


@pytest.mark.parametrize(
    ("field", "value", "reason"),
    [
        ("model", OTHER, "ModelMismatch"),
        ("objective", OTHER, "ObjectiveMismatch"),
        ("token", SOMEBODY, "TokenMismatch"),
        ("cost", 1, "CostMismatch"),
        ("lighthouse", SOMEBODY, "LighthouseMismatch"),
        ("validator", SOMEBODY, "ValidatorMismatch"),
    ],
)
def test_orders_that_differ_do_not_match(market: Market, field: str, value: Any, reason: str) -> None:
    assert market.refusal(market.creation(market.demand(), market.offer(**{field: value}))) == (reason,)
    assert market.refusal(market.creation(market.demand(**{field: value}), market.offer())) == (reason,)


def test_model_and_objective_do_not_flow_into_each_other(market: Market) -> None:
    """One byte moved from the objective to the model leaves the packed fields, and so the signature, the same."""
    demand, offer = market.pair()
    data = bytearray(order_abi(demand))
    data[320:352], data[416:448] = (35).to_bytes(32, "big"), (33).to_bytes(32, "big")
    assert market.refusal(market.creation(bytes(data), offer)) == ("MalformedOrder",)


def test_generations_do_not_mix(market: Market) -> None:
    demand = market.demand()
    market.generation = 8 - market.generation
    try:
        offer = market.offer()
    finally:
        market.generation = 8 - market.generation
    assert market.refusal(market.creation(demand, offer)) == ("GenerationMismatch",)


def test_orders_for_another_lighthouse_are_refused(market: Market) -> None:
    other = market.suite.create_lighthouse(name="other")
    orders = market.pair(lighthouse=other.address)
    assert market.refusal(market.creation(*orders)) == ("WrongLighthouse", other.address, market.lighthouse.address)
    orders = market.pair(lighthouse=SOMEBODY)
    assert market.refusal(market.creation(*orders))[0] == "WrongLighthouse"


def test_the_factory_refuses_an_outsider(market: Market) -> None:
    call = market.creation(*market.pair(), lighthouse=market.suite.factory)
    assert market.refusal(call, market.outsider) == ("NotALighthouse", market.outsider.address)


@pytest.mark.parametrize("late", ["demand", "offer"])
def test_an_order_ends_with_the_block_before_its_deadline(market: Market, late: str) -> None:
    following = market.suite.web3.eth.block_number + 1
    deadlines = {"demand": following + 1, "offer": following + 1, late: following}
    orders = market.demand(deadline=deadlines["demand"]), market.offer(deadline=deadlines["offer"])
    assert market.refusal(market.creation(*orders)) == ("DeadlineReached", following)
    market.create(deadline=following + 1)


@pytest.mark.parametrize("again", ["both", "demand", "offer"])
def test_an_order_is_used_once(market: Market, again: str) -> None:
    demand, offer = market.pair()
    market.suite.send(market.creation(demand, offer), market.provider)
    orders = (demand if again != "offer" else market.demand(), offer if again != "demand" else market.offer())
    used = offer if again == "offer" else demand

    refusal = market.refusal(market.creation(*orders))

    if market.generation == 3:
        assert refusal == ("OrderUsed", message_hash(used))
    else:
        assert refusal[:2] == ("WrongSigner", used.sender)


def test_used_hashes_are_kept_for_generation_3(market: Market) -> None:
    demand, offer = market.pair()
    market.suite.send(market.creation(demand, offer), market.provider)
    for order in (demand, offer):
        known = market.suite.factory.functions.isHashConsumed(message_hash(order)).call()
        assert known == (market.generation == 3)


def test_another_account_can_not_use_up_an_order(third: Market) -> None:
    """An account that signs copied terms with their nonce, and an offer for them, uses up only its own order."""
    victim, offer = third.pair()
    copied = third.outsider.signer.sign(replace(victim, signature=""))
    assert message_hash(copied) == message_hash(victim)
    own = third.creation(copied, third.offer(by=third.outsider))
    third.suite.send(own, third.provider)
    used = third.suite.factory.functions.isOrderUsed
    assert [used(message_hash(victim), person.address).call() for person in (third.outsider, third.promisee)] == [
        True,
        False,
    ]
    third.suite.send(third.creation(victim, offer), third.provider)
    assert used(message_hash(victim), third.promisee.address).call()
    for order, signer in ((copied, third.outsider), (victim, third.promisee)):
        again = third.creation(order, third.offer())
        assert third.refusal(again) == ("OrderUsed", message_hash(order)), signer
    assert not used(message_hash(victim), third.promisor.address).call()
    assert not used(bytes(32), ZERO_ADDRESS).call()


def test_lighthouses_of_two_chains_never_have_one_address(market: Market) -> None:
    """Orders do not name a chain; the address of their lighthouse depends on the number of its chain."""
    suite, address = market.suite, market.lighthouse.address
    code = bytes(suite.web3.eth.get_code(address))
    creation = bytes.fromhex(f"61{len(code):04x}3d81600a3d39f3") + code
    made_by = bytes.fromhex(suite.factory.address[2:])
    salt = keccak256(encode(["uint256", "uint256"], [2, suite.web3.eth.chain_id]))
    assert keccak256(b"\xff" + made_by + salt + keccak256(creation))[12:] == bytes.fromhex(address[2:])


def test_generation_5_counts_nonces(market: Market) -> None:
    nonces = [market.suite.factory.functions.nonceOf(person.address) for person in (market.promisee, market.promisor)]
    before = [nonce.call() for nonce in nonces]
    market.create()
    step = 1 if market.generation == 5 else 0
    assert [nonce.call() for nonce in nonces] == [count + step for count in before]


def test_a_wrong_nonce_or_sender_makes_the_signature_anothers(market: Market) -> None:
    if market.generation == 3:
        # Every nonce of generation 3 is a new order; what it must not be is an address.
        data = bytearray(order_abi(market.demand()))
        data[256:268] = bytes(12)
        assert market.refusal(market.creation(bytes(data), market.offer()))[0] == "GenerationMismatch"
        return
    ahead = market.creation(market.demand(ahead=1), market.offer())
    assert market.refusal(ahead)[:2] == ("WrongSigner", market.promisee.address)
    stolen = bytearray(order_abi(market.demand()))
    stolen[268:288] = bytes.fromhex(market.outsider.address[2:])
    assert market.refusal(market.creation(bytes(stolen), market.offer()))[:2] == (
        "WrongSigner",
        market.outsider.address,
    )


def high_s(signature: bytes) -> bytes:
    """The twin of a signature that the curve allows and we do not."""
    s = CURVE_ORDER - int.from_bytes(signature[32:64], "big")
    return signature[:32] + s.to_bytes(32, "big") + bytes((55 - signature[64],))


def low_v(signature: bytes) -> bytes:
    """The twin with v as 0 or 1."""
    return signature[:64] + bytes((signature[64] - 27,))


def nobodys(signature: bytes) -> bytes:
    """A signature that no key can have made."""
    return bytes(32) + signature[32:]


@pytest.mark.parametrize("forge", [high_s, low_v, nobodys])
@pytest.mark.parametrize("forged", ["demand", "offer"])
def test_only_one_signature_of_an_order_counts(market: Market, forge: Callable[[bytes], bytes], forged: str) -> None:
    demand, offer = market.pair()
    if forged == "demand":
        demand = replace(demand, signature=forge(bytes.fromhex(demand.signature)).hex())
    else:
        offer = replace(offer, signature=forge(bytes.fromhex(offer.signature)).hex())
    assert market.refusal(market.creation(demand, offer)) == ("InvalidSignature",)


@pytest.mark.parametrize(
    "spoil",
    [
        pytest.param(lambda data: b"", id="empty"),
        pytest.param(lambda data: data[:-1], id="truncated"),
        pytest.param(lambda data: data + b"\0", id="longer"),
        pytest.param(lambda data: b"\xff" * 640, id="garbage"),
        pytest.param(lambda data: b"\xff" * 7, id="short garbage"),
        pytest.param(lambda data: data[:31] + b"\0" + data[32:], id="offset"),
        pytest.param(lambda data: data[:352] + b"\x13" + data[353:], id="other multihash"),
        pytest.param(lambda data: data[:64] + b"\1" + data[65:], id="wide address"),
        pytest.param(lambda data: data[:415] + b"\1" + data[416:], id="padding of the model"),
        pytest.param(lambda data: data[:511] + b"\1" + data[512:], id="padding of the objective"),
        pytest.param(lambda data: data[:639] + b"\1", id="padding of the signature"),
    ],
)
@pytest.mark.parametrize("spoiled", [0, 1])
def test_bytes_that_are_not_an_order_are_refused(market: Market, spoil: Callable[[bytes], bytes], spoiled: int) -> None:
    orders = [order_abi(order) for order in market.pair()]
    orders[spoiled] = spoil(orders[spoiled])
    demand, offer = orders
    assert market.refusal(market.creation(demand, offer)) == ("MalformedOrder",)


def test_cost_and_fees_must_be_approved(market: Market) -> None:
    suite = market.suite
    for person in (market.promisee, market.promisor):
        suite.send(suite.xrt.functions.approve(suite.factory.address, XRT), person)
    short = ("ERC20InsufficientAllowance", suite.factory.address, XRT, 2 * XRT)
    validator = market.outsider.address if market.generation == 3 else suite.deploy("BrokenValidator").address
    assert market.refusal(market.creation(*market.pair(cost=2 * XRT))) == short
    assert market.refusal(market.creation(*market.pair(lighthouse_fee=2 * XRT))) == short
    assert market.refusal(market.creation(*market.pair(validator=validator, validator_fee=2 * XRT))) == short


def test_cost_and_fees_must_be_there(market: Market) -> None:
    suite = market.suite
    for person in (market.promisee, market.promisor):
        suite.send(suite.xrt.functions.approve(suite.factory.address, 2**256 - 1), person)
    validator = market.outsider.address if market.generation == 3 else suite.deploy("BrokenValidator").address
    for person, changes in (
        (market.promisee, {"cost": FUNDS + 1}),
        (market.promisor, {"lighthouse_fee": FUNDS + 1}),
        (market.promisee, {"validator": validator, "validator_fee": FUNDS + 1}),
    ):
        refusal = market.refusal(market.creation(*market.pair(**changes)))
        assert refusal == ("ERC20InsufficientBalance", person.address, FUNDS, FUNDS + 1)


def test_a_refusal_takes_nothing(market: Market) -> None:
    suite = market.suite
    before = [suite.balance(person) for person in suite.people], market.lighthouse.functions.quota().call()
    demand, offer = market.demand(cost=XRT), market.offer(cost=XRT, lighthouse_fee=FUNDS + 1)

    receipt = suite.attempt(market.creation(demand, offer), market.provider)

    assert receipt["status"] == 0
    assert ([suite.balance(person) for person in suite.people], market.lighthouse.functions.quota().call()) == before
    assert market.refusal(market.creation(demand, market.offer(cost=XRT))) == ()


def test_a_free_liability_needs_no_token(market: Market) -> None:
    liability = market.create(token=ZERO_ADDRESS)
    market.finalize(liability)
    assert liability.functions.token().call() == ZERO_ADDRESS
