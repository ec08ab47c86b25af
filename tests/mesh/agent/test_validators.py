"""Orders that an agent does not sign: their validator is a lighthouse, so they could be used as other orders."""

from __future__ import annotations

from itertools import count
from typing import TYPE_CHECKING

import pytest

from mesh.agent.agent import Agent
from mesh.chain import XRT, Chain, ContractNames, UnsafeValidator, deploy
from mesh.testing._market import RESEND, TIMING
from schemas import Demand, InvalidMessage, Offer
from tests.support.agent.trades import OBJECTIVE, waiting
from tests.support.market import MODEL, Place
from tests.support.orders import terms

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable

    from mesh.chain._contracts import ContractKind

KINDS = pytest.mark.parametrize(
    ("contracts", "generation"), [("mesh", 3), ("mesh", 5), ("original", 3), ("original", 5)]
)
_names = count(1)


async def trap(place: Place) -> str:
    """A lighthouse, made for the purpose."""
    name = f"agents-{next(_names)}"
    made = await place.chains["provider"].lighthouses.create(minimal_stake=XRT, timeout_blocks=5, name=name)
    return made.lighthouse


def chain_with(place: Place, role: str, contracts: ContractKind, generation: int) -> Chain:
    return Chain(
        place.node.provider,
        account=place.market.accounts[role],
        contracts=ContractNames(ens=place.market.deployment.ens, kind=contracts, generation=generation),
        timing=TIMING,
    )


async def foreign_trap(place: Place) -> str:
    """A lighthouse of another deployment on the same chain."""
    made = await deploy(place.chains["provider"].node, place.market.accounts["provider"])
    return made.lighthouse


@pytest.mark.parametrize("make_trap", [trap, foreign_trap])
@KINDS
async def test_a_robot_does_not_offer_where_its_offer_would_be_a_demand(
    place: Place, contracts: ContractKind, generation: int, make_trap: Callable[[Place], Awaitable[str]]
) -> None:
    """The stranger's demand, and the offer that it waits for."""
    lighthouse = await make_trap(place)
    settings = place.settings("robot", contracts=contracts, generation=generation)
    async with chain_with(place, "robot", contracts, generation) as chain:
        robot = Agent(MODEL, settings=settings, account=place.market.accounts["robot"], chain=chain, resend=RESEND)
        async with robot:
            trader = robot.runtime.trader
            shared = await trader.writer.terms(
                model=MODEL, objective=OBJECTIVE, cost=5, token="", validator=lighthouse, lifetime=100
            )
            stranger = place.market.accounts["person"]
            author = {"nonce": "ab" * 32} if generation == 3 else {"nonce": 0, "sender": stranger.address}
            demand = stranger.signer.sign(Demand(**(dict(shared) | author), validator_fee=0))

            with pytest.raises(UnsafeValidator) as caught:
                await trader.post(Offer, trader.writer.terms_of(demand), lighthouse_fee=0)
            assert (caught.value.code, caught.value.validator) == ("validator-unsafe", lighthouse)
            with pytest.raises(UnsafeValidator):
                await robot.demand(OBJECTIVE, cost=5, validator=lighthouse)
            with pytest.raises(UnsafeValidator):
                await robot.demand(OBJECTIVE, cost=5, validator=settings.lighthouse_contract)
            with pytest.raises(InvalidMessage) as same:
                await robot.demand(OBJECTIVE, cost=5, validator=settings.lighthouse_contract, validator_fee=1)
            assert same.value.reason == "validator"
            assert await waiting(robot) == []


async def test_an_order_is_published_only_with_a_validator_that_was_checked(place: Place) -> None:
    lighthouse = await trap(place)
    async with place.agent("robot") as robot:
        contract = (await place.chains["provider"].validators.deploy([robot.address], 1)).address
        for validator in (lighthouse, contract):
            with pytest.raises(UnsafeValidator):
                robot.send(Offer(**terms(validator=validator), lighthouse_fee=0))
        assert await robot.parts.chain.validators.is_safe(contract)
        robot.send(Offer(**terms(validator=contract), lighthouse_fee=0))
