"""Transfers and approvals that concern an agent's account, on its keys."""

from __future__ import annotations

import asyncio
from contextlib import asynccontextmanager
from typing import TYPE_CHECKING, Any

from mesh.agent._runtime import TokenEvents
from mesh.chain import Account, Approval, Transfer, new_private_key
from mesh.network import Endpoints, Network
from schemas.keys import EthEventKey
from schemas.rpc import ApprovalEvent, TransferEvent
from tests.mesh.agent.conftest import other_token
from tests.support.waiting import until, until_heard

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    import zenoh

    from mesh.agent.agent import Agent
    from tests.support.market import Place

ME, YOU, OTHERS = ("0x" + f"{number:02x}" * 20 for number in (1, 2, 3))


@asynccontextmanager
async def heard(place: Place, agent: Agent) -> AsyncIterator[list[Any]]:
    """The events that are published on the keys of the running agent."""
    events: list[Any] = []

    def hear(sample: zenoh.Sample) -> None:
        kind = TransferEvent if str(sample.key_expr).endswith("/transfer") else ApprovalEvent
        events.append(kind.decode(sample.payload.to_bytes()))

    async with Network(Endpoints(connect=(place.endpoint,))) as network:
        keys = [str(EthEventKey(agent.address, kind)) for kind in ("transfer", "approval")]
        subscribers: list[Any] = [network.session.declare_subscriber(key, hear) for key in keys]
        for key in keys:
            await until_heard(agent.parts.network.session, key)
        yield events
        for subscriber in subscribers:
            subscriber.undeclare()


async def until_handled(place: Place, agent: Agent) -> None:
    """Wait until the agent has handled all that is on the chain."""
    head = await place.chains["provider"].block_number()
    await until(lambda: agent.parts.chain_head.head >= head, what=f"block {head}", seconds=30)


async def test_transfers_and_approvals_of_the_agent_are_published_like_the_legacy_stack(place: Place) -> None:
    robot, person, provider = (place.address(role) for role in ("robot", "person", "provider"))
    async with place.agent("robot") as agent, heard(place, agent) as events:
        await place.chains["person"].tokens.transfer(robot, 11)
        await place.chains["robot"].tokens.transfer(provider, 12)
        await place.chains["robot"].tokens.approve(person, 13)
        await place.chains["person"].tokens.approve(robot, 14)
        await place.chains["robot"].tokens.transfer(robot, 15)
        await until(lambda: len(events) == 5, seconds=30)
    transfers = [event for event in events if isinstance(event, TransferEvent)]
    assert transfers == [
        TransferEvent(person, robot, 11),
        TransferEvent(robot, provider, 12),
        TransferEvent(robot, robot, 15),
    ]
    approvals = [event for event in events if isinstance(event, ApprovalEvent)]
    assert approvals == [ApprovalEvent(robot, person, 13), ApprovalEvent(person, robot, 14)]


async def test_transfers_and_approvals_between_others_are_not_published(place: Place) -> None:
    async with place.agent("robot") as agent, heard(place, agent) as events:
        await place.chains["person"].tokens.transfer(place.address("provider"), 1)
        await place.chains["person"].tokens.approve(place.address("provider"), 1)
        await place.chains["person"].tokens.transfer(agent.address, 2)
        await until(lambda: bool(events), seconds=30)
        await until_handled(place, agent)
    assert events == [TransferEvent(place.address("person"), place.address("robot"), 2)]


async def test_events_are_of_the_token_of_the_settings(place: Place) -> None:
    token, person = await other_token(place.chains["robot"], supply=100), place.address("person")
    async with place.agent("robot", erc20_token=token) as agent, heard(place, agent) as events:
        await place.chains["robot"].tokens.transfer(person, 1)
        await place.chains["robot"].tokens.transfer(person, 2, token=token)
        await until(lambda: bool(events), seconds=30)
        await until_handled(place, agent)
    assert events == [TransferEvent(place.address("robot"), person, 2)]


async def test_events_during_downtime_are_published_after_the_restart_and_none_twice(place: Place) -> None:
    person, robot = place.address("person"), place.address("robot")
    async with place.agent("robot") as agent, heard(place, agent) as events:
        await place.chains["person"].tokens.transfer(robot, 1)
        await until(lambda: bool(events), seconds=30)
        await until_handled(place, agent)
    await place.chains["person"].tokens.transfer(robot, 2)
    agent = place.agent("robot")
    published: list[Any] = []
    async with Network(Endpoints(connect=(place.endpoint,))) as network:
        key = str(EthEventKey(robot, "transfer"))
        subscriber: Any = network.session.declare_subscriber(
            key, lambda sample: published.append(TransferEvent.decode(sample.payload.to_bytes()))
        )
        async with agent:
            await place.chains["person"].tokens.transfer(robot, 3)
            await until(lambda: TransferEvent(person, robot, 3) in published, seconds=30)
            await until_handled(place, agent)
        subscriber.undeclare()
    assert TransferEvent(person, robot, 1) not in published
    assert len(published) == len(set(published))


async def test_a_transfer_in_another_block_after_a_reorganisation_is_published_once(place: Place) -> None:
    chain, person = place.chains["person"], place.address("person")
    friend = Account(new_private_key()).address
    async with place.agent("robot") as agent, heard(place, agent) as events:
        await chain.tokens.transfer(friend, 1)  # what goes before, so that there is a block to go back to
        tx = await chain.tokens.transfer(agent.address, 7)
        await until(lambda: len(events) == 1, seconds=30)
        await until_handled(place, agent)
        raw = await raw_of(place, tx)
        await place.forget_blocks(1)
        await place.node.request("eth_sendRawTransaction", [raw])
        receipt = await chain.node.receipt(tx)
        assert receipt is not None
        assert receipt.status == 1
        await chain.tokens.transfer(agent.address, 8)
        await until(lambda: events[-1].args_value == 8, seconds=30)
        await until_handled(place, agent)
    assert events == [TransferEvent(person, place.address("robot"), value) for value in (7, 8)]


async def raw_of(place: Place, tx: str) -> str:
    """A mined transaction, as it was signed."""
    sent = await place.node.request("eth_getTransactionByHash", [tx])
    number = {name: int(sent[name], 16) for name in ("nonce", "gas", "value", "chainId")}
    prices = {name: int(sent[name], 16) for name in ("maxFeePerGas", "maxPriorityFeePerGas")}
    fields = {**number, **prices, "to": place.market.deployment.xrt, "data": sent["input"], "type": 2}
    signed = await asyncio.to_thread(place.market.accounts["person"].sign_transaction, fields)
    assert signed.hash == tx
    return "0x" + signed.raw.hex()


def published_by(*events: Transfer | Approval, reverted: tuple[Transfer | Approval, ...] = ()) -> list[str]:
    """The last parts of the keys when `events` are published, `reverted` ones reverted, and all published again."""
    keys: list[str] = []
    token_events = TokenEvents(lambda key, _: keys.append(key.rpartition("/")[2]), ME)
    for event in events:
        token_events.publish(event)
    for event in reversed(reverted):
        token_events.revert(event)
    for event in events:
        token_events.publish(event)
    return keys


def test_equal_events_of_one_transaction_are_several() -> None:
    twice = Transfer(ME, YOU, 5, "0x1"), Transfer(ME, YOU, 5, "0x1")
    assert published_by(*twice) == ["transfer"] * 4
    assert published_by(*twice, reverted=twice) == ["transfer"] * 2
    assert published_by(*twice, reverted=twice[:1]) == ["transfer"] * 3


def test_an_equal_event_of_another_transaction_is_published() -> None:
    assert published_by(Approval(ME, YOU, 5, "0x1"), reverted=(Approval(ME, YOU, 5, "0x2"),)) == ["approval"] * 2
    assert published_by(Approval(OTHERS, YOU, 5, "0x1")) == []
