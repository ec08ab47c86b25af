"""Permits beside the demands that are posted: a customer needs no ether, and sends no transaction."""

from __future__ import annotations

import secrets
from contextlib import asynccontextmanager
from typing import TYPE_CHECKING, Any

import msgspec
from msgspec.structs import replace

from mesh.chain import Account, TransactionSender
from mesh.chain._permits import permit_arguments
from mesh.chain.deploy import XRT
from mesh.market._earnings import GAS
from schemas import encode
from schemas.rpc import AcceptDemand, OrderPair, SendDemand, SendOffer, SendPermit
from tests.bridges.web.test_page_server import COST, signed_demand
from tests.bridges.web.test_web_robots import contract_of, demand_of, made
from tests.mesh.market.test_free_contracts import COVERED
from tests.support.agent.trades import working
from tests.support.market import MODEL
from tests.support.waiting import until_found

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    from mesh.chain import Chain
    from schemas import Permit
    from tests.support.market import Place


@asynccontextmanager
async def penniless(place: Place) -> AsyncIterator[tuple[Account, Chain]]:
    """A person with XRT and without ether, which has paid `COST` at the end, and nothing else."""
    account = Account(secrets.token_bytes(32))
    await place.chains["provider"].tokens.transfer(account.address, XRT)
    async with place.chain_of(account, 3) as chain:
        yield account, chain
        assert await chain.tokens.eth_balance() == 0
        assert await chain.node.transaction_count(account.address, block="pending") == 0
        assert await chain.tokens.balance() == XRT - COST
        assert await chain.tokens.allowance(account.address, chain.factory) == 0


def together(permit: Any, demand: bytes) -> bytes:
    return b"[" + encode(permit) + b"," + demand + b"]"


async def paid(browser: Any, order_hash: str) -> Any:
    address = await contract_of(browser, order_hash)

    async def ended() -> Any:
        job = await browser.get(f"liabilities/{address}")
        return job if job["liability"]["state"] == "paid" else None

    return await until_found(ended, what="a payment")


# The server has a node, and so permits, of its own: the provider knows those only that are sent to it.


async def test_a_demand_is_posted_with_its_permit(place: Place, serve: Any) -> None:
    async with (
        place.provider(),
        working(place.agent("robot")),
        serve("person") as browser,
        penniless(place) as (account, chain),
    ):
        demand = await signed_demand(browser, account, await made(browser))
        refused = (await browser.post("orders", demand, status=400))["error"]
        assert (refused["reason"], "permit" in refused["hint"]) == ("ERC20InsufficientAllowance", True)
        permit = await chain.permits.sign(chain.xrt, COST)
        posted = await browser.post("orders", together(permit, demand), status=202)
        await paid(browser, posted["order"]["hash"])


async def test_a_pair_has_its_permit(place: Place, serve: Any) -> None:
    async with (
        place.provider(),
        working(place.agent("robot")) as robot,
        serve("person") as browser,
        penniless(place) as (account, chain),
    ):
        signer, demand = account.signer, await demand_of(browser, cost=COST)
        asked = AcceptDemand(demand=SendDemand.of(demand), robot=robot.address, maker=signer.address)
        accepted = await browser.post("pairs/offers", asked.signed_by(signer).encode())
        offer = SendOffer.decode(msgspec.json.encode(accepted["offer"]))
        pair = OrderPair(demand=SendDemand.of(signer.sign(demand)), offer=offer, maker=signer.address)
        refused = await browser.post("pairs", pair.signed_by(signer).encode(), status=400)
        assert refused["error"]["reason"] == "ERC20InsufficientAllowance"
        permit = await chain.permits.sign(chain.xrt, COST)
        assert permit is not None
        pair = replace(pair, permit=SendPermit.of(permit))
        forged = replace(pair, permit=SendPermit.of(replace(permit, value=COST + 1)))
        await browser.post("pairs", forged.signed_by(signer).encode(), status=400)
        posted = await browser.post("pairs", pair.signed_by(signer).encode(), status=202)
        assert (await paid(browser, posted["order"]["hash"]))["liability"]["promisor"] == robot.address


async def used_up(place: Place, permit: Permit) -> None:
    """Let the token take a permit, as that of an order from elsewhere is taken."""
    node, account = place.chains["provider"].node, place.chains["provider"].account
    assert account is not None
    value, deadline, v, r, s = permit_arguments(permit)
    call = node.contract("XRT", permit.token).permit(permit.owner, permit.spender, value, deadline, v, r, s)
    await TransactionSender(node, account).send(to=permit.token, data=call.data)


async def test_a_permit_that_another_order_used_is_posted_anew(place: Place, serve: Any) -> None:
    async with place.provider(), serve("person") as browser, penniless(place) as (account, chain):
        demand = await signed_demand(browser, account, await made(browser))
        first, other = await chain.permits.sign(chain.xrt, COST), await chain.permits.sign(chain.xrt, 0)
        assert first is not None
        assert other is not None
        await browser.post("permits", encode(first), status=404)  # for no order
        posted = await browser.post("orders", together(first, demand), status=202)
        await used_up(place, other)
        second = await chain.permits.sign(chain.xrt, COST)
        assert second is not None
        await browser.post("permits", encode(replace(second, value=COST + 1)), status=400)
        await browser.post("permits", demand, status=400)
        await browser.post("permits", encode(second), status=202)
        assert (await browser.post("permits", encode(second), status=400))["error"]["reason"] == "permit"
        async with working(place.agent("robot")):
            await paid(browser, posted["order"]["hash"])


async def test_the_local_account_orders_by_a_permit(place: Place, serve: Any) -> None:
    chain = place.chains["person"]
    async with place.provider(), working(place.agent("robot")), serve("person") as browser:
        before = await chain.node.transaction_count(place.address("person"), block="pending")
        wanted = {"model": MODEL, "objective": await made(browser), "cost": str(COST)}
        posted = await browser.post("local/orders", wanted, status=202)
        await paid(browser, posted["order"]["hash"])
        assert await chain.node.transaction_count(place.address("person"), block="pending") == before


async def test_an_account_may_order_by_permits_where_a_provider_takes_them(place: Place, serve: Any) -> None:
    with_ether, without = place.address("person"), Account(secrets.token_bytes(32)).address
    async with serve() as browser:

        async def may(account: str) -> bool:
            return bool((await browser.get(f"accounts/{account}"))["permits"])

        assert not await may(with_ether)
        assert await may(without)  # it can't do anything else
        async with place.provider():
            assert await may(with_ether)
    async with serve(settings={"contracts": "original"}) as browser, place.provider():
        assert not (await browser.get(f"accounts/{without}"))["permits"]


async def test_an_account_is_told_what_a_provider_wants_for_its_permit(place: Place, serve: Any) -> None:
    path = f"accounts/{place.address('person')}/permit-fee"
    async with serve() as browser:

        async def fee(cost: int) -> int:
            return int((await browser.get(path, cost=str(cost)))["fee"])

        assert await fee(5) == 0  # nobody is here
        async with place.provider(free_contracts=0):
            assert await fee(5) == COVERED - 5 + GAS.permit_fee
            assert await fee(COVERED) == 0
            for cost in ("many", str(2**256)):
                await browser.get(path, status=400, cost=cost)
        async with place.provider():
            assert await fee(5) == 0


async def test_a_permit_for_anything_but_the_demand_is_refused(place: Place, serve: Any) -> None:
    account, other = Account(secrets.token_bytes(32)), Account(secrets.token_bytes(32))
    await place.chains["provider"].tokens.transfer(account.address, XRT)
    async with serve("person") as browser, place.chain_of(account, 3) as chain:
        demand = await signed_demand(browser, account, MODEL)
        permit = await chain.permits.sign(chain.xrt, COST)
        assert permit is not None
        known, sign = browser.server.api._parts.chain.permits, account.signer.sign
        for wrong, reason in (
            (other.signer.sign(replace(permit, owner=other.address, signature="")), "permit"),
            (sign(replace(permit, token=other.address)), "permit"),
            (sign(replace(permit, spender=other.address)), "permit"),
            (sign(replace(permit, value=COST - 1)), "ERC20InsufficientAllowance"),
            (sign(replace(permit, deadline=1)), "ERC20InsufficientAllowance"),
            (sign(replace(permit, domain="ab" * 32, value=COST + 1)), "ERC20InsufficientAllowance"),
        ):
            refused = (await browser.post("orders", together(wrong, demand), status=400))["error"]
            assert (refused["code"], refused["reason"]) == ("order-unusable", reason)
        assert not known.has_any_of(other.address)
        for body in (
            together(replace(permit, value=1), demand),  # nobody has signed this
            b"[" + demand + b"," + encode(permit) + b"]",
            b"[" + encode(permit) + b"]",
            b"[" + b",".join([encode(permit)] * 2 + [demand]) + b"]",
            b"[" * 5000,
        ):
            assert (await browser.post("orders", body, status=400))["error"]["code"] == "invalid-message"
        await browser.post("orders", encode(permit), status=400)  # alone it orders nothing
        assert (await browser.get("orders"))["orders"] == []
