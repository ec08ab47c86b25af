"""The listener: nothing on the chain that concerns an agent is missed."""

from __future__ import annotations

import asyncio
import logging
from typing import TYPE_CHECKING, Any

import pytest

from mesh.base.background import Background
from mesh.chain import Chain, Timing
from mesh.chain.following import FOLLOW_LIMITS
from mesh.chain.liabilities import Liabilities
from mesh.dev import JsonRpcServer
from mesh.role import following
from schemas import message_hash
from tests.support.agent.listeners import RecordingListener, contract, finalize, ledger, listening, opened, started
from tests.support.log_events import logged_events
from tests.support.orders import RECORDING
from tests.support.ports import free_port
from tests.support.waiting import until

if TYPE_CHECKING:
    from collections.abc import Sequence

    from mesh.agent.ledger import Ledger
    from schemas import Liability
    from tests.support.market import Place

__all__ = ["ledger"]

QUICK_TO_GIVE_UP = Timing(poll_interval=0.03, attempts=1)


async def test_a_contract_that_names_the_account_is_reported_with_its_orders(place: Place, ledger: Ledger) -> None:
    async with listening(place, ledger) as listener:
        await started(ledger)
        address, demand, offer = await contract(place)
        await until(lambda: listener.liabilities)
    ((liability, demand_hash, offer_hash),) = listener.liabilities
    assert (liability.address, liability.promisor) == (address, place.address("robot"))
    assert (demand_hash, offer_hash) == (message_hash(demand), message_hash(offer))


async def test_contracts_of_others_are_left_out(place: Place, ledger: Ledger) -> None:
    async with listening(place, ledger) as listener:
        await started(ledger)
        await contract(place, promisor="provider")
        mine, *_ = await contract(place)
        await until(lambda: listener.liabilities)
    assert [liability.address for liability, *_ in listener.liabilities] == [mine]


@pytest.mark.parametrize("together", [True, False])
async def test_of_several_new_contracts_only_those_of_the_account_are_read(
    together: bool, place: Place, ledger: Ledger, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of many at once; a single one is read by the call that says whose it is, and not again."""
    read: list[str] = []
    get, get_all = Liabilities.get_with_orders, Liabilities.get_all_with_orders

    async def counted(liabilities: Liabilities, address: str) -> Any:
        read.append(address)
        return await get(liabilities, address)

    async def counted_together(liabilities: Liabilities, addresses: Sequence[str]) -> Any:
        read.extend(addresses)
        return await get_all(liabilities, addresses)

    monkeypatch.setattr(Liabilities, "get_with_orders", counted)
    monkeypatch.setattr(Liabilities, "get_all_with_orders", counted_together)
    async with opened(place, ledger) as listener:
        made = [(await contract(place, promisor=who))[0] for who in ("provider", "robot", "provider", "robot")]
        if together:
            await place.node.mine(FOLLOW_LIMITS.recent)
        async with Background() as tasks:
            tasks.start(listener.run(), "listener")
            await until(lambda: len(listener.liabilities) == 2)
    assert [liability.address for liability, *_ in listener.liabilities] == made[1::2]
    assert read == (made[1::2] if together else made)


async def test_a_finalization_is_reported_with_its_result(place: Place, ledger: Ledger) -> None:
    async with listening(place, ledger) as listener:
        await started(ledger)
        address, *_ = await contract(place)
        await finalize(place, address)
        await until(lambda: listener.ends)
    assert listener.ends == [(address, True, RECORDING)]


async def test_of_contracts_of_others_only_the_end_of_a_watched_one_is_reported(place: Place, ledger: Ledger) -> None:
    async with listening(place, ledger) as listener:
        await started(ledger)
        others = [(await contract(place, promisor="provider"))[0] for _ in range(3)]
        await listener.watched.read(others[1])
        for address in others:
            await finalize(place, address, promisor="provider")
        mine, *_ = await contract(place)
        await finalize(place, mine)
        await until(lambda: len(listener.ends) == 2)
    assert [address for address, *_ in listener.ends] == [others[1], mine]


async def test_a_new_agent_begins_at_the_head(place: Place, ledger: Ledger) -> None:
    await contract(place)
    head = await place.chains["robot"].block_number()
    async with listening(place, ledger) as listener:
        await started(ledger)
        assert (await ledger.cursor())[0] == head
        later, *_ = await contract(place)
        await until(lambda: listener.liabilities)
    assert [liability.address for liability, *_ in listener.liabilities] == [later]


async def test_events_during_a_downtime_are_read_afterwards(place: Place, ledger: Ledger) -> None:
    async with listening(place, ledger):
        await started(ledger)
    address, *_ = await contract(place)
    await finalize(place, address)
    async with listening(place, ledger) as listener:
        await until(lambda: listener.ends)
    assert [liability.address for liability, *_ in listener.liabilities] == [address]
    assert listener.ends[0][0] == address


async def test_a_block_that_was_not_handled_to_its_end_is_handled_again(place: Place, ledger: Ledger) -> None:
    class Crashing(RecordingListener):
        async def new_liability(
            self, liability: Liability, *, demand_hash: bytes, offer_hash: bytes, created: int | None = None
        ) -> None:
            raise ZeroDivisionError

    async with opened(place, ledger, kind=Crashing) as listener:
        running = asyncio.create_task(listener.run())
        await started(ledger)
        address, *_ = await contract(place)
        with pytest.raises(ZeroDivisionError):
            await running
    async with listening(place, ledger) as listener:
        await until(lambda: listener.liabilities)
    assert [liability.address for liability, *_ in listener.liabilities] == [address]


async def test_the_head_is_reported_and_saved_as_the_chain_grows(
    place: Place, ledger: Ledger, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(following, "SAVE_SECONDS", 0.0)
    async with listening(place, ledger) as listener:
        await started(ledger)
        await place.node.mine(3)
        head = await place.chains["robot"].block_number()
        await until(lambda: listener.head >= head)
    assert (await ledger.cursor())[0] == listener.head


async def test_an_outage_of_the_node_is_survived_and_logged_once(
    place: Place, ledger: Ledger, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO, "mesh")
    port = free_port()
    async with JsonRpcServer(place.node.provider, port=port) as server:
        chain = Chain(server.url, contracts=place.market.deployment.contracts, timing=QUICK_TO_GIVE_UP)
        async with chain, listening(place, ledger, chain=chain) as listener:
            await started(ledger)
            await server.__aexit__(None, None, None)
            address, *_ = await contract(place)
            await until(lambda: "chain-outage" in logged_events(caplog))
            async with JsonRpcServer(place.node.provider, port=port):
                await until(lambda: listener.liabilities)
                assert listener.liabilities[0][0].address == address
    outages = [event for event in logged_events(caplog) if event in ("chain-outage", "chain-recovered")]
    assert outages == ["chain-outage", "chain-recovered"]
