"""`aira order`, and what `aira demand` says about orders."""

from __future__ import annotations

import asyncio
import json
from typing import TYPE_CHECKING, Any

import pytest

from mesh.agent.orders import OrderState
from mesh.cli import demand as commands
from mesh.cli.order import list_orders, withdraw
from mesh.errors import InputError
from mesh.network import Endpoints, Network
from schemas import RejectKey, verify
from schemas.signing import Rejection
from tests.support.cli.site import MODEL, Site, settings_of
from tests.support.commands import coroutine
from tests.support.raising import raises_with
from tests.support.waiting import until

if TYPE_CHECKING:
    from pathlib import Path

    import zenoh

    from tests.support.nodes import Anvil
    from tests.support.routers import EmbeddedRouter


demand = coroutine(commands.demand)


@pytest.fixture
async def site(anvil: Anvil, router: EmbeddedRouter, tmp_path: Path) -> Site:
    return await Site.found(anvil.url, anvil.private_keys, router.endpoint, tmp_path)


async def test_an_account_without_a_ledger_has_no_orders(site: Site, capsys: pytest.CaptureFixture[str]) -> None:
    await coroutine(list_orders)(settings_of(site, "poor"), as_json=False)
    assert capsys.readouterr().out == f"no open orders of {site.address('poor')}\n"
    await coroutine(list_orders)(settings_of(site, "poor"), as_json=True)
    assert json.loads(capsys.readouterr().out) == []
    assert not (site.folder / "state" / site.address("poor")).exists()


async def test_orders_are_listed_and_withdrawn_by_their_hash(site: Site, capsys: pytest.CaptureFixture[str]) -> None:
    settings = settings_of(site, "person")
    async with site.agent("person") as person:
        orders = [await person.order(site.job("one"), cost=cost) for cost in (5, 6)]
    await coroutine(list_orders)(settings, as_json=True)
    listed = json.loads(capsys.readouterr().out)
    assert [(one["hash"], one["kind"], one["state"], one["cost"]) for one in listed] == [
        (order.hash, "demand", "open", order.message.cost) for order in orders
    ]
    assert all(0 < one["blocksLeft"] <= one["deadline"] for one in listed)
    with raises_with(InputError, code="unknown-order"):
        await coroutine(withdraw)(settings, ("00" * 32,), everything=False, on_chain=False, as_json=True)
    with raises_with(InputError, code="invalid-options"):
        await coroutine(withdraw)(settings, ("",), everything=False, on_chain=False, as_json=True)
    await coroutine(withdraw)(settings, (orders[0].hash[:20],), everything=False, on_chain=False, as_json=True)
    (fact,) = json.loads(capsys.readouterr().out)
    assert fact == {
        "hash": orders[0].hash,
        "kind": "demand",
        "deadline": orders[0].deadline,
        "providers": 0,
        "confirmedBy": 0,
        "honouredBy": [],
        "tx": None,
    }
    await coroutine(list_orders)(settings, as_json=False)
    printed = capsys.readouterr().out
    assert all(order.hash in printed for order in orders)
    assert [word for word in printed.split() if word in ("open", "withdrawn")] == ["open", "withdrawn"]
    await coroutine(withdraw)(settings, (), everything=True, on_chain=False, as_json=False)
    said = capsys.readouterr().out
    assert f"demand {orders[1].hash} is withdrawn" in said
    assert "may still become a contract" in said


async def test_the_provider_confirms_a_withdrawal_and_does_not_match_the_order(
    site: Site, capsys: pytest.CaptureFixture[str]
) -> None:
    done: list[str] = []
    async with site.provider():
        async with site.agent("person") as person:
            old = await person.order(site.job("withdrawn"), cost=5)
        await coroutine(withdraw)(
            settings_of(site, "person"), (old.hash,), everything=False, on_chain=False, as_json=True
        )
        (fact,) = json.loads(capsys.readouterr().out)
        assert (fact["providers"], fact["confirmedBy"]) == (1, 1)
        assert fact["honouredBy"] == [site.accounts["provider"].address]
        async with site.robot(done) as robot, site.agent("person") as person:
            await robot.offer(objective=old.message.objective, cost=5)
            contract = await person.demand(site.job("wanted"), cost=5)
            assert (await contract.outcome()).success
            assert [order.hash for order in person.orders(OrderState.WITHDRAWN)] == [old.hash]
    assert done == ["wanted"]


async def test_a_rejection_is_told_with_what_it_means(site: Site, capsys: pytest.CaptureFixture[str]) -> None:
    settings = settings_of(site, "person")
    order: dict[str, Any] = {
        "model": MODEL,
        "objective": str(site.job("word")),
        "cost": "7wn",
        "validator_fee": "0",
        "validator": "",
    }
    async with site.agent("person") as person:
        another = await person.order(site.job("another"), cost=3)
    waiting = asyncio.create_task(demand(settings, **order, out=None, as_json=True, lifetime=100))
    provider = site.accounts["provider"]
    async with Network(Endpoints(connect=(site.endpoint,))) as network:
        orders: list[str] = []

        def hear(sample: zenoh.Sample) -> None:
            if (digest := verify(sample.payload.to_bytes()).hash.hex()) != another.hash:
                orders.append(digest)

        network.session.declare_subscriber(f"aira/{site.lighthouse}/demand/*", hear)
        await until(lambda: orders, what="the demand", seconds=60)
        unsigned = Rejection(order=orders[0], reason="Unwanted", detail="not today", provider=provider.address)
        key = str(RejectKey(site.lighthouse, site.accounts["person"].address))
        network.session.put(key, unsigned.signed_by(provider.signer).encode())
        said: list[str] = []
        notes: list[str] = []

        def is_told() -> bool:
            captured = capsys.readouterr()
            said.append(captured.out)
            notes.append(captured.err)
            return "not today" in "".join(said)

        await until(is_told)
    facts = {"kind": "rejected", "agent": provider.address, "code": "Unwanted", "detail": "not today"}
    assert facts in map(json.loads, "".join(said).splitlines())
    assert "1 other open order;" in "".join(notes)
    assert not waiting.done()
    waiting.cancel()
    await asyncio.wait([waiting])
    text = capsys.readouterr().err
    assert "stays valid until block" in text
    assert f"aira order withdraw {orders[0][:16]}" in text
