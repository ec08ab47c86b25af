"""Permits: which tokens an account signs them for, and whose permits are remembered."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Any

import pytest
from msgspec.structs import replace

from mesh.chain import TransactionSender
from mesh.chain._abi import encode
from mesh.chain._permits import PERMIT_LIMITS, Permits
from schemas import ZERO_ADDRESS, Permit, keccak256, verify_message
from tests.support import orders
from tests.support.clocks import SECOND, SetClock
from tests.support.contracts.suite import artifact

if TYPE_CHECKING:
    from mesh.chain import Account, Chain
    from tests.mesh.chain.conftest import DeployedMarket

pytestmark = pytest.mark.asyncio(loop_scope="module")


async def deploy_token(chain: Chain, name: str, version: str, *, domain_of: str = ZERO_ADDRESS) -> str:
    """A token that takes every permit, with the domain of another one or with its own."""
    code = bytes.fromhex(artifact("VersionedToken")["bytecode"].removeprefix("0x"))
    arguments = encode(["uint256", "string", "string", "address"], [10**9, name, version, domain_of])
    assert chain.account is not None
    receipt = await TransactionSender(chain.node, chain.account).send(to=None, data=code + arguments)
    return str(receipt.contract)


def permit_of(account: Account, chain: Chain, **fields: Any) -> Permit:
    """A permit of a token that nobody has deployed, unless `fields` say else."""
    terms: dict[str, Any] = {"spender": chain.factory, "token": chain.xrt, "value": 1000, "nonce": 0}
    terms |= {"owner": account.address, "deadline": int(time.time()) + 3600, "domain": "11" * 32}
    return account.signer.sign(Permit(**(terms | fields)))


@pytest.mark.parametrize("version", ["1", "2"])
async def test_a_permit_is_signed_for_a_token_that_has_its_own_domain(market: DeployedMarket, version: str) -> None:
    async with market.chain(market.stranger) as chain:
        token = await deploy_token(chain, "USD Coin", version)
        permit = await chain.permits.sign(token, 1000)
        assert permit is not None
        assert chain.permits.own(token) == permit
        assert await chain.permits.sign(chain.xrt, 1000) is not None, "it has no version, so 1"


async def test_nothing_is_signed_for_a_token_with_the_domain_of_another(market: DeployedMarket) -> None:
    """Else it could make its customers approve amounts of a token that is worth more."""
    async with market.chain(market.stranger) as chain:
        token = await deploy_token(chain, "Robonomics", "1", domain_of=chain.xrt)
        xrt = await chain.permits.sign(chain.xrt, 1000)
        assert xrt is not None
        assert await chain.node.read(chain.node.contract("XRT", token).DOMAIN_SEPARATOR()) == bytes.fromhex(xrt.domain)
        assert await chain.permits.sign(token, 1000) is None
        assert chain.permits.own(token) is None


async def test_a_copy_that_names_another_token_takes_no_permits_place(market: DeployedMarket) -> None:
    """A permit's signature does not cover the token that it names, so strangers can change that."""
    person = market.stranger
    async with market.chain(person) as signing:
        token = await deploy_token(signing, "USD Coin", "2")
        true, other = await signing.permits.sign(token, 1000), await signing.permits.sign(signing.xrt, 2000)
    assert true is not None
    assert other is not None
    async with market.chain() as chain:
        for number in range(PERMIT_LIMITS.per_owner + 1):
            copied = replace(other, token="0x" + f"{number:040x}")
            assert chain.permits.note(verify_message(copied).message) == (number == 0)
        assert not chain.permits.note(replace(other, token=token))
        assert chain.permits.note(true)
        for permit, cost in ((true, 1000), (other, 2000)):
            named = token if permit is true else chain.xrt
            demand = verify_message(orders.demand(signer=person.signer, token=named, cost=cost))
            found = await chain.funds.permit_for(demand)
            assert found is not None
            assert found.signature == permit.signature
            assert "Allowance" not in (await chain.funds.shortages([demand]))[0]


async def test_permits_of_one_owner_are_bounded(market: DeployedMarket) -> None:
    async with market.chain() as chain:
        most = PERMIT_LIMITS.per_owner
        made = [permit_of(market.stranger, chain, domain=keccak256(bytes([n])).hex()) for n in range(most + 1)]
        assert [chain.permits.note(permit) for permit in made] == most * [True] + [False]
        assert chain.permits.note(permit_of(market.stranger, chain, domain=made[0].domain, nonce=1))
        assert len(chain.permits) == most


async def test_permits_of_earlier_nonces_stay_while_there_is_room(market: DeployedMarket) -> None:
    async with market.chain() as chain:
        many = [permit_of(market.stranger, chain, nonce=number) for number in range(PERMIT_LIMITS.per_owner)]
        other = permit_of(market.stranger, chain, domain=keccak256(b"another token").hex())
        assert all(chain.permits.note(permit) for permit in (*many, other))
        assert [*chain.permits] == [*many[1:], other]
        assert not chain.permits.note(many[0])
        assert [chain.permits.of(one.owner, bytes.fromhex(one.domain), one.nonce) for one in many] == [None, *many[1:]]


async def test_a_permit_is_known_again_after_a_reorganisation(market: DeployedMarket) -> None:
    """The token has taken a permit, the next one is signed, and the chain goes back: only the first one helps."""
    person = market.stranger
    async with market.chain(person) as signing, market.chain() as chain:
        first = await signing.permits.sign(signing.xrt, 1000)
        assert first is not None
        later = permit_of(person, chain, token=chain.xrt, domain=first.domain, nonce=first.nonce + 1)
        assert all(chain.permits.note(permit) for permit in (later, first))
        demand = verify_message(orders.demand(signer=person.signer, token=chain.xrt, cost=1000))
        assert await chain.funds.permit_for(demand) == first
        assert "Allowance" not in (await chain.funds.shortages([demand]))[0]


async def test_a_permit_takes_the_place_of_one_that_is_expired(market: DeployedMarket) -> None:
    clock = SetClock(time.time_ns())
    async with market.chain() as chain:
        permits = Permits(chain.permits._contracts, clock=clock)
        assert permits.note(permit_of(market.stranger, chain, value=2000))
        less = permit_of(market.stranger, chain, deadline=int(time.time()) + 7200)
        assert not permits.note(less)
        clock.pass_by(3601 * SECOND)
        assert permits.note(less)
        assert [*permits] == [less]


@pytest.mark.parametrize("fields", [{"spender": "0x" + "11" * 20}, {"deadline": 1}])
async def test_what_can_not_be_used_is_not_remembered(market: DeployedMarket, fields: dict[str, Any]) -> None:
    async with market.chain() as chain:
        assert not chain.permits.note(permit_of(market.stranger, chain, **fields))
        assert [*chain.permits] == []
