"""Which validators orders may name, and what could be done with an order whose validator is a lighthouse."""

from __future__ import annotations

from itertools import count
from typing import TYPE_CHECKING, Any
from unittest.mock import AsyncMock

import pytest
from msgspec.structs import asdict

from mesh.chain import (
    XRT,
    Account,
    Chain,
    Timing,
    UnsafeValidator,
    _validators,
    deploy,
    new_private_key,
)
from mesh.chain._validators import DELEGATION
from mesh.chain.transactions import TransactionSender
from mesh.errors import InputError
from schemas import ZERO_ADDRESS, Demand, Offer, message_hash, recover
from tests.mesh.chain.conftest import PLAN, QUICK, next_nonce, reverted
from tests.support.raising import raises_with

if TYPE_CHECKING:
    from mesh.chain import NewLighthouse
    from tests.mesh.chain.conftest import DeployedMarket

pytestmark = pytest.mark.asyncio(loop_scope="module")

KINDS = [("mesh", 3), ("original", 3), ("original", 5)]
CONTRACTS = pytest.mark.parametrize(("contracts", "generation"), KINDS)

_numbers = count(1)


async def trap(market: DeployedMarket) -> NewLighthouse:
    """A lighthouse of the stranger's, who is its only provider."""
    async with market.chain(market.provider) as chain:
        await chain.tokens.transfer(market.stranger.address, 10 * XRT)
    async with market.chain(market.stranger) as chain:
        name = f"trap-{next(_numbers)}"
        made = await chain.lighthouses.create(minimal_stake=XRT, timeout_blocks=5, name=name)
        await chain.tokens.approve(made.lighthouse, 5 * XRT)
        await chain.lighthouses.refill(made.lighthouse, 5 * XRT)
    return made


def exchanged(offer: Offer) -> Demand:
    """The demand whose signature is that of the offer."""
    fields = asdict(offer)
    fields["validator_fee"] = fields.pop("lighthouse_fee")
    fields["lighthouse"], fields["validator"] = offer.validator, offer.lighthouse
    return Demand(**fields)


async def author(chain: Chain, account: Account, generation: int) -> dict[str, Any]:
    """The fields of an order by which a generation names its author."""
    if generation == 3:
        return {"nonce": next_nonce()}
    return {"nonce": await chain.liabilities.next_nonce(account.address), "sender": account.address}


@pytest.mark.parametrize("generation", [3, 5])
async def test_an_offer_whose_validator_is_a_lighthouse_takes_nothing_from_the_robot(
    market: DeployedMarket, generation: int
) -> None:
    robot, thief = market.promisor, market.stranger
    made = await trap(market)
    async with market.chain(thief) as chain:
        before = await chain.tokens.balance(robot.address)
        offer = market.offer(cost=5, validator=made.lighthouse, **await author(chain, robot, generation))
        stolen = exchanged(offer)
        assert recover(message_hash(stolen), stolen.signature) == robot.address
        counter = market.offer(
            thief,
            cost=5,
            deadline=stolen.deadline,
            lighthouse=stolen.lighthouse,
            validator=stolen.validator,
            **await author(chain, thief, generation),
        )
        with reverted("ValidatorIsLighthouse"):
            await chain.liabilities.create(made.lighthouse, stolen, counter)
        assert await chain.tokens.balance(robot.address) == before
        with pytest.raises(UnsafeValidator) as caught:
            await chain.validators.check(offer)
        assert (caught.value.code, caught.value.validator) == ("validator-unsafe", made.lighthouse)


@CONTRACTS
async def test_no_lighthouse_is_a_validator(market: DeployedMarket, contracts: Any, generation: int) -> None:
    made = await trap(market)
    async with market.chain(kind=contracts, generation=generation) as chain:
        for lighthouse in (made.lighthouse, market.deployment.lighthouse):
            assert chain.validators.known(lighthouse) is None
            assert not await chain.validators.is_safe(lighthouse)
            assert chain.validators.known(lighthouse) is False


@pytest.mark.parametrize("generation", [3, 5])
async def test_an_offer_is_a_demand_on_another_deployment_to_which_the_robot_has_an_allowance(
    market: DeployedMarket, generation: int
) -> None:
    """Why nobody signs it: neither deployment knows the other's lighthouses, so the second one takes the tokens."""
    robot, thief = market.promisor, market.stranger
    async with market.chain(market.deployer) as chain:
        other = await deploy(chain.node, market.deployer, plan=PLAN)
        second = Chain(chain.node, account=market.deployer, contracts=other.contracts)
        async with second:
            await second.tokens.transfer(thief.address, 5 * XRT)
    async with Chain(market.endpoint, account=thief, contracts=other.contracts, timing=QUICK) as theirs:
        await theirs.tokens.approve(other.lighthouse, 5 * XRT)
        await theirs.lighthouses.refill(other.lighthouse, 5 * XRT)
        async with market.chain(robot) as chain:
            await chain.tokens.approve(other.factory, 5)
            before = await chain.tokens.balance(robot.address)
            offer = market.offer(cost=5, validator=other.lighthouse, **await author(theirs, robot, generation))
            with pytest.raises(UnsafeValidator):
                await chain.validators.check(offer)
            stolen = exchanged(offer)
            shared = {name: getattr(stolen, name) for name in ("deadline", "lighthouse", "validator")}
            counter = market.offer(thief, cost=5, **shared, **await author(theirs, thief, generation))
            await theirs.liabilities.create(other.lighthouse, stolen, counter)
            assert await chain.tokens.balance(robot.address) == before - 5


@CONTRACTS
async def test_only_what_can_be_no_lighthouse_anywhere_is_a_validator(
    market: DeployedMarket, contracts: Any, generation: int
) -> None:
    async with market.chain(market.stranger) as chain:
        jury = await chain.validators.deploy([market.stranger.address], 1)
        other = await deploy(chain.node, market.deployer, plan=PLAN)
    foreign = [other.lighthouse, other.factory, market.deployment.xrt]
    async with market.chain(kind=contracts, generation=generation) as chain:
        for validator in (jury.address, market.promisee.address):
            assert await chain.validators.is_safe(validator)
            assert chain.validators.known(validator)
        for stranger in foreign:
            assert not await chain.validators.is_safe(stranger)
            assert chain.validators.known(stranger) is False
            assert await chain.validators.settled.is_safe(stranger), "a provider signs no orders"
        assert chain.validators.known(ZERO_ADDRESS)


@CONTRACTS
async def test_the_operator_lists_further_contracts_but_no_lighthouse_of_the_market(
    market: DeployedMarket, contracts: Any, generation: int
) -> None:
    listed = ("nobody.robonomics.eth", "xrt.3.robonomics.eth", market.deployment.lighthouse)
    async with market.chain(kind=contracts, generation=generation, validators=listed) as chain:
        assert await chain.validators.is_safe(market.deployment.xrt)
        assert not await chain.validators.is_safe(market.deployment.factory)
        assert not await chain.validators.is_safe(market.deployment.lighthouse)


@pytest.mark.parametrize("transactions", [0, 1])
async def test_an_account_that_delegates_to_a_contract_is_an_account(
    market: DeployedMarket, monkeypatch: pytest.MonkeyPatch, transactions: int
) -> None:
    """EIP-7702: its code may be another one tomorrow, so it is no validator of generation 5."""
    address = Account(new_private_key()).address
    code, count = AsyncMock(return_value=DELEGATION + bytes(20)), AsyncMock(return_value=transactions)
    async with market.chain() as chain:
        monkeypatch.setattr(chain.node, "code", code)
        monkeypatch.setattr(chain.node, "transaction_count", count)
        assert await chain.validators.is_safe(address) is (transactions == 1)
        assert await chain.validators.quorum(address) == 0
        with raises_with(InputError, code="validator-without-code"):
            await chain.validators.check_named(address, generation=5)


@CONTRACTS
async def test_an_address_that_may_become_a_lighthouse_is_refused(
    market: DeployedMarket, contracts: Any, generation: int
) -> None:
    unused = Account(new_private_key()).address
    async with market.chain(kind=contracts, generation=generation) as chain:
        assert not await chain.validators.is_safe(unused)
        assert await chain.validators.settled.is_safe(unused) is (contracts == "mesh")
        assert chain.validators.known(unused) is False
    timing = Timing(validator_recheck=0.0)
    async with market.chain(kind=contracts, generation=generation, timing=timing) as chain:
        await chain.validators.is_safe(unused)
        assert chain.validators.known(unused) is None, "a transaction can change it"


async def test_a_limited_number_of_verdicts_is_remembered(
    market: DeployedMarket, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(_validators, "REMEMBERED", 2)
    asked = (market.deployment.xrt, market.promisee.address, market.promisor.address)
    async with market.chain() as chain:
        for validator in asked:
            await chain.validators.is_safe(validator)
        assert [chain.validators.known(validator) is None for validator in asked] == [True, False, False]


async def test_an_account_is_made_known_with_one_transaction(market: DeployedMarket) -> None:
    fresh = Account(new_private_key())
    async with market.chain(market.deployer) as chain:
        await TransactionSender(chain.node, market.deployer).send(to=fresh.address, data=b"", value=10**18)
    async with market.chain(fresh) as chain:
        assert not await chain.validators.is_safe(fresh.address)
        for _ in range(2):
            await chain.validators.introduce()
            assert await chain.node.transaction_count(fresh.address) == 1
    async with market.chain() as chain:
        assert await chain.validators.is_safe(fresh.address)
