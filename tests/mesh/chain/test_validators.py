"""Which validators orders may name, and what could be done with an order whose validator is a lighthouse."""

from __future__ import annotations

from itertools import count
from typing import TYPE_CHECKING, Any

import pytest
from msgspec.structs import asdict

from mesh.chain import XRT, Account, Timing, UnsafeValidator, new_private_key, validators
from schemas import ZERO_ADDRESS, Demand, Offer, message_hash, recover
from tests.mesh.chain.conftest import next_nonce, reverted

if TYPE_CHECKING:
    from mesh.chain import Chain, NewLighthouse
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
    async with market.chain(contracts=contracts, generation=generation) as chain:
        for lighthouse in (made.lighthouse, market.deployment.lighthouse):
            assert chain.validators.known(lighthouse) is None
            assert not await chain.validators.is_safe(lighthouse)
            assert chain.validators.known(lighthouse) is False


@CONTRACTS
async def test_contracts_and_accounts_with_transactions_are_validators(
    market: DeployedMarket, contracts: Any, generation: int
) -> None:
    async with market.chain(contracts=contracts, generation=generation) as chain:
        for validator in (market.deployment.xrt, market.promisee.address):
            assert await chain.validators.is_safe(validator)
            assert chain.validators.known(validator)
        assert chain.validators.known(ZERO_ADDRESS)


@CONTRACTS
async def test_an_address_that_may_become_a_lighthouse_is_refused_where_the_contracts_would_accept_that(
    market: DeployedMarket, contracts: Any, generation: int
) -> None:
    unused = Account.from_key(new_private_key()).address
    async with market.chain(contracts=contracts, generation=generation) as chain:
        assert await chain.validators.is_safe(unused) is (contracts == "mesh")
        assert chain.validators.known(unused) is not None
    timing = Timing(validator_recheck=0.0)
    async with market.chain(contracts=contracts, generation=generation, timing=timing) as chain:
        await chain.validators.is_safe(unused)
        assert chain.validators.known(unused) is None, "a transaction can change it"


async def test_a_limited_number_of_verdicts_is_remembered(
    market: DeployedMarket, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(validators, "REMEMBERED", 2)
    asked = (market.deployment.xrt, market.promisee.address, market.promisor.address)
    async with market.chain() as chain:
        for validator in asked:
            await chain.validators.is_safe(validator)
        assert [chain.validators.known(validator) is None for validator in asked] == [True, False, False]
