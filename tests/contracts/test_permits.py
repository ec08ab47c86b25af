"""Liabilities whose cost the promisee has approved by a signature (EIP-2612), and the fee for carrying it."""

from __future__ import annotations

import itertools
from typing import TYPE_CHECKING, Any

import pytest
from eth_account import Account
from msgspec.structs import replace

from mesh.chain.answers import explain
from schemas import Permit, keccak256, message_hash, order_abi
from tests.contracts.test_creation_rules import high_s, low_v, nobodys
from tests.support.contracts.chains import py_evm
from tests.support.contracts.evm import Evm
from tests.support.contracts.market import permit_arguments
from tests.support.contracts.suite import REFUND_DELAY, XRT, Suite

if TYPE_CHECKING:
    from collections.abc import Callable

    from web3.contract import Contract

    from schemas import Demand, Offer
    from tests.support.contracts.market import Market

pytestmark = pytest.mark.sample("market")

COST, FEE = 3 * XRT, XRT
NOTHING_APPROVED = "ERC20InsufficientAllowance"


@pytest.fixture
def market(market: Market) -> Market:
    """The promisee has approved nothing to anybody."""
    market.suite.send(market.suite.xrt.functions.approve(market.suite.factory.address, 0), market.promisee)
    return market


def orders(market: Market, fee: int = 0, **changes: object) -> tuple[Demand, Offer]:
    return market.pair(**{"cost": COST, "validator_fee": fee, **changes})


def holdings(market: Market, token: Contract | None = None) -> tuple[int, int, int]:
    """What promisee, factory and provider hold."""
    held = (token or market.suite.xrt).functions.balanceOf
    accounts = (market.promisee, market.suite.factory, market.provider)
    promisee, factory, provider = (int(held(account.address).call()) for account in accounts)
    return promisee, factory, provider


def moved(before: tuple[int, ...], after: tuple[int, ...]) -> tuple[int, ...]:
    return tuple(then - now for now, then in zip(before, after, strict=True))


def transactions(market: Market) -> int:
    """How many the promisee has sent."""
    return int(market.suite.web3.eth.get_transaction_count(market.promisee.address))  # type: ignore[arg-type]


def allowance(market: Market, token: Contract | None = None) -> int:
    allowed = (token or market.suite.xrt).functions.allowance
    return int(allowed(market.promisee.address, market.suite.factory.address).call())


def refusal(market: Market, pair: tuple[Demand, Offer], permit: Permit) -> tuple[object, ...]:
    return market.refusal(market.permitted_creation(*pair, permit))


def create(market: Market, pair: tuple[Demand, Offer], permit: Permit) -> Contract:
    return market.liability_of(market.suite.send(market.permitted_creation(*pair, permit), market.provider))


def foreign(market: Market) -> Contract:
    """Another token with permits, of which the promisee has some."""
    token = market.suite.deploy("XRT", 100 * XRT)
    market.suite.send(token.functions.transfer(market.promisee.address, 50 * XRT))
    return token


@pytest.mark.parametrize("fee", [0, FEE])
@pytest.mark.parametrize("is_foreign", [False, True])
def test_a_signature_pays_for_a_job(market: Market, is_foreign: bool, fee: int) -> None:
    token = foreign(market) if is_foreign else market.suite.xrt
    before, sent = holdings(market, token), transactions(market)

    liability = create(market, orders(market, fee, token=token.address), market.permit(COST + fee, token=token))

    assert moved(before, holdings(market, token)) == (-COST - fee, COST, fee)
    assert allowance(market, token) == 0
    assert transactions(market) == sent
    market.finalize(liability)
    assert token.functions.balanceOf(market.suite.factory.address).call() == before[1]
    assert liability.functions.isSuccess().call()


def test_the_promisee_signs_what_every_wallet_signs(market: Market) -> None:
    """As eth_account makes signatures of EIP-712 from the token's own fields."""
    permit = market.permit(COST)
    domain = {
        "name": "Robonomics",
        "version": "1",
        "chainId": market.suite.web3.eth.chain_id,
        "verifyingContract": market.suite.xrt.address,
    }
    fields = ("owner", "address"), ("spender", "address"), ("value", "uint256"), ("nonce", "uint256")
    types = {"Permit": [{"name": name, "type": kind} for name, kind in (*fields, ("deadline", "uint256"))]}
    values = {field["name"]: getattr(permit, field["name"]) for field in types["Permit"]}
    key = market.suite.chain.keys[market.suite.people.index(market.promisee)]
    assert Account.sign_typed_data(key, domain, types, values).signature.hex() == permit.signature
    market.suite.send(market.permission(permit), market.outsider)
    assert allowance(market) == COST


def test_a_permit_for_less_than_cost_and_fee_pays_for_nothing(market: Market) -> None:
    short = (NOTHING_APPROVED, market.suite.factory.address)
    assert refusal(market, orders(market), market.permit(COST - 1)) == (*short, COST - 1, COST)
    assert refusal(market, orders(market, FEE), market.permit(COST + FEE - 1)) == (*short, COST - 1, COST)
    assert refusal(market, orders(market, FEE), market.permit(FEE - 1)) == (*short, FEE - 1, FEE)


def test_a_permit_counts_once(market: Market) -> None:
    permit = market.permit(COST)
    create(market, orders(market), permit)
    assert refusal(market, orders(market), permit)[0] == NOTHING_APPROVED
    assert market.refusal(market.permission(permit), market.outsider)[0] == "ERC2612InvalidSigner"


@pytest.mark.parametrize("fee", [0, FEE])
def test_a_permit_that_somebody_brings_before_works_all_the_same(market: Market, fee: int) -> None:
    """Else anybody could stop an order, by sending what they see in the queue of transactions."""
    permit, before = market.permit(COST + fee), holdings(market)
    market.suite.send(market.permission(permit), market.outsider)
    create(market, orders(market, fee), permit)
    assert moved(before, holdings(market)) == (-COST - fee, COST, fee)


def test_a_permit_for_another_spender_does_not_count(market: Market) -> None:
    permit = market.permit(COST, spender=market.outsider.address)
    assert refusal(market, orders(market), permit)[0] == NOTHING_APPROVED


def test_an_expired_permit_does_not_count(market: Market) -> None:
    permit = market.permit(COST, deadline=market.suite.web3.eth.get_block("latest")["timestamp"] - 1)
    assert refusal(market, orders(market), permit)[0] == NOTHING_APPROVED
    assert market.refusal(market.permission(permit), market.outsider) == ("ERC2612ExpiredSignature", permit.deadline)


def test_a_permit_of_another_chain_or_token_does_not_count(market: Market) -> None:
    for domain in (foreign(market).functions.DOMAIN_SEPARATOR().call().hex(), domain_of(market, chain_id=10)):
        permit = market.permit(COST, domain=domain)
        assert refusal(market, orders(market), permit)[0] == NOTHING_APPROVED
    assert domain_of(market, chain_id=market.suite.web3.eth.chain_id) == market.permit(COST).domain


def domain_of(market: Market, *, chain_id: int) -> str:
    """XRT's domain on a chain (EIP-712)."""
    kind = b"EIP712Domain(string name,string version,uint256 chainId,address verifyingContract)"
    words = (keccak256(kind), keccak256(b"Robonomics"), keccak256(b"1"), chain_id.to_bytes(32, "big"))
    return keccak256(b"".join(words) + bytes(12) + bytes.fromhex(market.suite.xrt.address[2:])).hex()


def test_a_permit_that_another_account_signed_does_not_count(market: Market) -> None:
    permit = market.permit(COST)
    forged = replace(permit, signature=market.permit(COST, by=market.outsider).signature)
    assert refusal(market, orders(market), forged)[0] == NOTHING_APPROVED
    assert market.refusal(market.permission(forged), market.outsider)[0] == "ERC2612InvalidSigner"
    zero = replace(forged, owner="0x" + "00" * 20)
    assert market.refusal(market.permission(zero), market.outsider)[0] == "ERC2612InvalidSigner"


@pytest.mark.parametrize("forge", [high_s, low_v, nobodys])
def test_only_one_signature_of_a_permit_counts(market: Market, forge: Callable[[bytes], bytes]) -> None:
    permit = market.permit(COST + FEE)
    forged = replace(permit, signature=forge(bytes.fromhex(permit.signature)).hex())
    assert market.refusal(market.permission(forged), market.outsider) == ("InvalidSignature",)
    assert refusal(market, orders(market), forged)[0] == NOTHING_APPROVED
    market.suite.send(market.permission(permit), market.outsider)
    assert refusal(market, orders(market, FEE), forged) == ("InvalidSignature",)


def test_a_permit_with_another_order_takes_what_that_order_says(market: Market) -> None:
    """A permit is for no particular order: whoever has it can use it with any that the promisee has signed."""
    cheap, permit, before = orders(market, cost=XRT), market.permit(COST + FEE), holdings(market)
    create(market, cheap, permit)
    assert moved(before, holdings(market)) == (-XRT, XRT, 0)
    assert allowance(market) == COST + FEE - XRT
    assert refusal(market, cheap, permit)[0] in ("OrderUsed", "WrongSigner")


def test_nobody_is_charged_a_fee_without_a_permit(market: Market) -> None:
    """Clients without permits may sign a fee of the validator where there is no validator; it was never charged."""
    suite = market.suite
    suite.send(suite.xrt.functions.approve(suite.factory.address, 10 * XRT), market.promisee)
    pair, before = orders(market, FEE), holdings(market)
    forged = market.permit(COST + FEE, nonce=7)
    expired = market.permit(COST + FEE, deadline=1)
    for permit in (forged, expired, market.permit(COST + FEE, by=market.outsider)):
        assert refusal(market, pair, permit) == ("FeeNotPermitted", market.promisee.address)
    suite.send(market.creation(*pair), market.provider)
    assert moved(before, holdings(market)) == (-COST, COST, 0)


def test_a_fee_needs_the_last_permit(market: Market) -> None:
    first, second = market.permit(COST), market.permit(COST + FEE, nonce=market.permit(0).nonce + 1)
    pair = orders(market, FEE)
    for permit in (first, second):
        market.suite.send(market.permission(permit), market.outsider)
    assert refusal(market, pair, first) == ("FeeNotPermitted", market.promisee.address)
    create(market, pair, second)


def test_with_a_validator_the_fee_is_the_validators(market: Market) -> None:
    suite = market.suite
    validator = market.outsider.address if market.generation == 3 else suite.deploy("BrokenValidator").address
    before = holdings(market)
    create(market, orders(market, FEE, validator=validator), market.permit(COST + FEE))
    assert moved(before, holdings(market)) == (-COST - FEE, COST + FEE, 0)


def test_a_refund_returns_the_cost_and_not_the_fee(market: Market) -> None:
    before = holdings(market)
    liability = create(market, orders(market, FEE), market.permit(COST + FEE))
    market.suite.chain.mine(REFUND_DELAY)
    market.suite.send(market.suite.factory.functions.refund(liability.address), market.provider)
    assert moved(before, holdings(market)) == (-FEE, 0, FEE)


def test_only_a_provider_in_its_turn_carries_a_permit(market: Market) -> None:
    suite, pair, permit = market.suite, orders(market), market.permit(COST)
    call = market.permitted_creation(*pair, permit)
    assert market.refusal(call, market.outsider) == ("NotAProvider", market.outsider.address)
    direct = market.permitted_creation(*pair, permit, at=suite.factory)
    assert market.refusal(direct, market.outsider) == ("NotALighthouse", market.outsider.address)


def test_tokens_without_permits_are_approved_as_before(market: Market) -> None:
    suite = market.suite
    for name in ("StrictToken", "PhantomToken"):
        token = suite.deploy(name, 100 * XRT)
        suite.send(token.functions.transfer(market.promisee.address, 50 * XRT))
        permit = market.promisee.signer.sign(replace(market.permit(COST + FEE), token=token.address, signature=""))
        assert market.refusal(market.permitted_creation(*orders(market, token=token.address), permit)) != ()
        suite.send(token.functions.approve(suite.factory.address, 2 * COST + FEE), market.promisee)
        # No signature says that this token's owner has agreed to a fee, though a call of `permit` may succeed.
        charged = market.permitted_creation(*orders(market, FEE, token=token.address), permit)
        assert suite.attempt(charged, market.provider)["status"] == 0
        before = holdings(market, token)
        create(market, orders(market, token=token.address), permit)
        assert moved(before, holdings(market, token)) == (-COST, COST, 0)


def test_a_token_that_lies_about_a_permit_pays_nobody(market: Market) -> None:
    suite = market.suite
    token = suite.deploy("LyingToken", 100 * XRT)
    suite.send(token.functions.transfer(market.promisee.address, 50 * XRT))
    before = holdings(market, token)
    for fee in (0, FEE):
        permit = market.permit(COST + fee, token=token)
        call = market.permitted_creation(*orders(market, fee, token=token.address), permit)
        assert suite.attempt(call, market.provider)["status"] == 0
    assert holdings(market, token) == before


def test_a_token_that_calls_back_from_its_permit_pays_for_each_order_once(market: Market) -> None:
    suite = market.suite
    token = suite.deploy("CallingToken", 100 * XRT)
    suite.send(token.functions.transfer(market.promisee.address, 50 * XRT))
    suite.send(suite.xrt.functions.transfer(token.address, 10 * XRT))
    lighthouse = market.lighthouse
    for target, data in (
        (suite.xrt, suite.xrt.encode_abi("approve", [lighthouse.address, 10 * XRT])),
        (lighthouse, lighthouse.encode_abi("refill", [10 * XRT])),
    ):
        suite.send(token.functions.act(target.address, data))
    suite.chain.mine(30)  # so that the token may take the turn
    pair, permit = orders(market, FEE, token=token.address), market.permit(COST + FEE, token=token)
    creation = lighthouse.encode_abi(
        "createLiabilityWithPermit", [*(order_abi(order) for order in pair), *permit_arguments(permit)]
    )
    suite.send(token.functions.setHook(lighthouse.address, creation))
    before, provided = holdings(market, token), token.functions.balanceOf(token.address).call()

    suite.send(token.functions.act(lighthouse.address, creation))

    assert not token.functions.called().call()
    used = "OrderUsed" if market.generation == 3 else "WrongSigner"
    assert explain(token.functions.answer().call()).reason == used
    assert moved(before, holdings(market, token)) == (-COST - FEE, COST, 0)
    assert token.functions.balanceOf(token.address).call() == provided + FEE


def test_permits_are_for_one_side_of_a_chain_that_splits() -> None:
    evm = Evm((suite := Suite(py_evm())).chain)
    owner, spender = suite.people[1:3]

    def bring(domain: bytes) -> str | None:
        fields: dict[str, Any] = {"owner": owner.address, "spender": spender.address, "token": suite.xrt.address}
        permit = owner.signer.sign(Permit(**fields, value=1, nonce=0, deadline=2**64, domain=domain.hex()))
        function = "permit(address,address,uint256,uint256,uint8,bytes32,bytes32)"
        arguments = (owner.address, spender.address, *permit_arguments(permit))
        return evm.call(suite.xrt.address, function, *arguments, sender=spender.address).refusal

    def domain() -> bytes:
        return evm.call(suite.xrt.address, "DOMAIN_SEPARATOR()", sender=owner.address).output

    before = domain()
    evm.become_chain(7)
    assert bring(before) == "ERC2612InvalidSigner"
    assert domain() != before
    assert bring(domain()) is None


def test_a_permit_names_its_owner_to_every_reader(market: Market) -> None:
    permit = market.permit(COST)
    assert message_hash(permit) != message_hash(replace(permit, value=COST + 1))
    fields = itertools.product(("owner", "spender"), (market.outsider.address,))
    assert len({message_hash(replace(permit, **{field: value})) for field, value in fields}) == 2
