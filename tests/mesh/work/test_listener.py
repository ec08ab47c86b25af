"""The listener: nothing on the chain that concerns an agent is missed."""

from __future__ import annotations

import asyncio
import logging
import secrets
from contextlib import asynccontextmanager
from typing import TYPE_CHECKING, Any

import pytest
from web3.providers.async_base import AsyncBaseProvider

from mesh.background import Background
from mesh.chain import Approval, Chain, ChainWentBack, History, JsonRpcServer, NewLiability, Timing, Transfer
from mesh.work import Ledger
from mesh.work import listener as listener_module
from mesh.work.listener import Listener
from schemas import Demand, Offer, Result, message_hash
from tests.support.market import QUICK
from tests.support.orders import RECORDING, terms
from tests.support.waiting import until, until_found

if TYPE_CHECKING:
    from collections.abc import AsyncIterator
    from pathlib import Path

    from web3.types import RPCEndpoint, RPCResponse

    from schemas import Liability
    from tests.support.market import Place


QUICK_TO_GIVE_UP = Timing(poll_interval=0.03, attempts=1, request_timeout=2)


class Diary:
    """A party that writes down what it is told."""

    def __init__(self) -> None:
        self.liabilities: list[tuple[Liability, bytes, bytes]] = []
        self.ends: list[tuple[str, bool, str]] = []
        self.taken_back_ends: list[str] = []
        self.taken_back_contracts: list[str] = []
        self.token_events: list[Transfer | Approval] = []
        self.taken_back_token_events: list[Transfer | Approval] = []
        self.head = 0

    async def new_liability(self, liability: Liability, *, demand_hash: bytes, offer_hash: bytes) -> None:
        self.liabilities.append((liability, demand_hash, offer_hash))

    async def finalized(self, address: str, *, success: bool, result: str) -> None:
        self.ends.append((address, success, result))

    async def taken_back(self, address: str) -> None:
        self.taken_back_ends.append(address)

    async def unmade(self, address: str) -> None:
        self.taken_back_contracts.append(address)

    async def token_event(self, event: Transfer | Approval) -> None:
        self.token_events.append(event)

    async def token_event_taken_back(self, event: Transfer | Approval) -> None:
        self.taken_back_token_events.append(event)

    async def new_head(self, block: int) -> None:
        self.head = block


@pytest.fixture
async def ledger(tmp_path: Path) -> AsyncIterator[Ledger]:
    async with Ledger(tmp_path / "ledger.sqlite") as opened:
        yield opened


@asynccontextmanager
async def listening(
    place: Place, ledger: Ledger, role: str = "robot", *, chain: Chain | None = None
) -> AsyncIterator[Diary]:
    diary = Diary()
    listener = Listener(chain or place.chains[role], ledger, place.address(role), diary)
    async with Background() as tasks:
        tasks.start(listener.run(), "listener")
        yield diary


async def started(ledger: Ledger) -> None:
    """Wait until a listener has chosen its first block."""

    async def chosen() -> bool:
        return await ledger.cursor(Listener.NAME) is not None

    await until_found(chosen)


async def contract(place: Place, *, promisor: str = "robot") -> tuple[str, Demand, Offer]:
    """A liability between the person and the promisor, made by the provider."""
    deployment = place.market.deployment
    fields = terms(token=deployment.xrt, cost=0, lighthouse=deployment.lighthouse, nonce=secrets.token_hex(32))
    demand = place.market.accounts["person"].signer.sign(Demand(**fields, validator_fee=0))
    offer = place.market.accounts[promisor].signer.sign(Offer(**fields, lighthouse_fee=0))
    created = await place.chains["provider"].create_liability(deployment.lighthouse_name, demand, offer)
    return created.liability, demand, offer


async def finalize(place: Place, address: str) -> None:
    result = place.market.accounts["robot"].signer.sign(Result(liability=address, result=RECORDING, success=True))
    await place.chains["provider"].finalize(place.market.deployment.lighthouse_name, result)


async def test_a_contract_that_names_the_account_is_told_with_its_orders(place: Place, ledger: Ledger) -> None:
    async with listening(place, ledger) as diary:
        await started(ledger)
        address, demand, offer = await contract(place)
        await until(lambda: diary.liabilities)
    ((liability, demand_hash, offer_hash),) = diary.liabilities
    assert (liability.address, liability.promisor) == (address, place.address("robot"))
    assert (demand_hash, offer_hash) == (message_hash(demand), message_hash(offer))


async def test_contracts_of_others_are_left_out(place: Place, ledger: Ledger) -> None:
    async with listening(place, ledger) as diary:
        await started(ledger)
        await contract(place, promisor="provider")
        mine, *_ = await contract(place)
        await until(lambda: diary.liabilities)
    assert [liability.address for liability, *_ in diary.liabilities] == [mine]


async def test_the_end_of_a_contract_is_told_with_its_result(place: Place, ledger: Ledger) -> None:
    async with listening(place, ledger) as diary:
        await started(ledger)
        address, *_ = await contract(place)
        await finalize(place, address)
        await until(lambda: diary.ends)
    assert diary.ends == [(address, True, RECORDING)]


async def test_one_that_never_ran_begins_at_the_head(place: Place, ledger: Ledger) -> None:
    await contract(place)
    head = await place.chains["robot"].block_number()
    async with listening(place, ledger) as diary:
        await started(ledger)
        assert await ledger.cursor(Listener.NAME) == head
        later, *_ = await contract(place)
        await until(lambda: diary.liabilities)
    assert [liability.address for liability, *_ in diary.liabilities] == [later]


async def test_what_happens_while_the_agent_is_down_is_read_when_it_is_back(place: Place, ledger: Ledger) -> None:
    async with listening(place, ledger):
        await started(ledger)
    address, *_ = await contract(place)
    await finalize(place, address)
    async with listening(place, ledger) as diary:
        await until(lambda: diary.ends)
    assert [liability.address for liability, *_ in diary.liabilities] == [address]
    assert diary.ends[0][0] == address


async def test_a_block_that_was_not_handled_to_its_end_is_handled_again(place: Place, ledger: Ledger) -> None:
    class Crashing(Diary):
        async def new_liability(self, liability: Liability, *, demand_hash: bytes, offer_hash: bytes) -> None:
            raise ZeroDivisionError

    listener = Listener(place.chains["robot"], ledger, place.address("robot"), Crashing())
    running = asyncio.create_task(listener.run())
    await started(ledger)
    address, *_ = await contract(place)
    with pytest.raises(ZeroDivisionError):
        await running
    async with listening(place, ledger) as diary:
        await until(lambda: diary.liabilities)
    assert [liability.address for liability, *_ in diary.liabilities] == [address]


async def test_the_head_is_told_as_the_chain_grows_and_kept(place: Place, ledger: Ledger) -> None:
    async with listening(place, ledger) as diary:
        await started(ledger)
        await place.node.mine(3)
        head = await place.chains["robot"].block_number()
        await until(lambda: diary.head >= head)
    assert await ledger.cursor(Listener.NAME) == diary.head


async def test_a_lost_node_is_waited_for_and_said_once(
    place: Place, ledger: Ledger, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(listener_module, "RETRY", 0.02)
    caplog.set_level(logging.INFO, "mesh.work.listener")
    async with JsonRpcServer(place.node.provider) as server:
        port = int(server.url.rpartition(":")[2])
        chain = Chain(server.url, ens=place.market.deployment.ens, timing=QUICK_TO_GIVE_UP)
        async with chain, listening(place, ledger, chain=chain) as diary:
            await started(ledger)
            await server.__aexit__(None, None, None)
            address, *_ = await contract(place)
            await until(lambda: "can't be read" in caplog.text)
            await asyncio.sleep(0.2)
            async with JsonRpcServer(place.node.provider, port=port):
                await until(lambda: diary.liabilities)
                assert diary.liabilities[0][0].address == address
    assert caplog.text.count("can't be read") == 1
    assert caplog.text.count("can be read again") == 1


async def test_a_chain_that_is_shorter_than_what_was_read_is_refused(place: Place, ledger: Ledger) -> None:
    await ledger.set_cursor(Listener.NAME, 10**6)
    listener = Listener(place.chains["robot"], ledger, place.address("robot"), Diary())
    with pytest.raises(ChainWentBack):
        await listener.run()


async def test_an_end_that_the_chain_took_back_is_told(place: Place, ledger: Ledger) -> None:
    async with listening(place, ledger) as diary:
        await started(ledger)
        address, *_ = await contract(place)
        await finalize(place, address)
        await until(lambda: diary.ends)
        await place.forget_blocks(1)
        await until(lambda: diary.taken_back_ends)
        await finalize(place, address)
        await until(lambda: len(diary.ends) == 2)
    assert diary.taken_back_ends == [address]
    assert diary.ends[0][0] == diary.ends[1][0] == address
    assert len(diary.liabilities) == 1, "what came before is as it was"


async def test_an_end_that_was_taken_back_while_the_agent_was_down_is_told(place: Place, ledger: Ledger) -> None:
    async with listening(place, ledger) as diary:
        await started(ledger)
        address, *_ = await contract(place)
        await finalize(place, address)
        head = await place.chains["robot"].block_number()
        await until(lambda: diary.head >= head)
    await place.forget_blocks(1)
    async with listening(place, ledger) as diary:
        await until(lambda: diary.taken_back_ends)
    assert diary.taken_back_ends == [address]


async def test_a_contract_that_the_chain_took_back_is_told_and_told_again_when_it_is_made(
    place: Place, ledger: Ledger
) -> None:
    async with listening(place, ledger) as diary:
        await started(ledger)
        first, demand, offer = await contract(place)
        await until(lambda: diary.liabilities)
        await place.forget_blocks(1)
        await until(lambda: diary.taken_back_contracts)
        lighthouse = place.market.deployment.lighthouse_name
        again = await place.chains["provider"].create_liability(lighthouse, demand, offer)
        await until(lambda: len(diary.liabilities) == 2)
    assert diary.taken_back_contracts == [first]
    assert [liability.address for liability, *_ in diary.liabilities] == [first, again.liability]
    assert diary.taken_back_ends == []


async def test_token_events_are_told_and_taken_back(place: Place, ledger: Ledger) -> None:
    person = place.chains["person"]
    async with listening(place, ledger) as diary:
        await started(ledger)
        await person.approve(place.address("robot"), 11)
        await person.transfer(place.address("robot"), 12)
        await until(lambda: len(diary.token_events) == 2)
        await place.forget_blocks(1)
        await until(lambda: diary.taken_back_token_events)
    approval, transfer = diary.token_events
    assert isinstance(approval, Approval)
    assert (approval.owner, approval.spender, approval.value) == (place.address("person"), place.address("robot"), 11)
    assert isinstance(transfer, Transfer)
    assert (transfer.sender, transfer.recipient, transfer.value) == (
        place.address("person"),
        place.address("robot"),
        12,
    )
    assert diary.taken_back_token_events == [transfer]


async def test_as_much_of_the_chain_is_remembered_as_may_be_replaced_whatever_was_so_before(
    place: Place, ledger: Ledger
) -> None:
    for depth in (3, 7, 2):
        timing = Timing(poll_interval=0.03, reorg_depth=depth)
        async with (
            Chain(place.node.provider, ens=place.market.deployment.ens, timing=timing) as chain,
            listening(place, ledger, chain=chain) as diary,
        ):
            await started(ledger)
            for _ in range(2 * depth):
                await contract(place)
                head = await chain.block_number()
                await until(lambda diary=diary, head=head: diary.head >= head)  # type: ignore[misc]
        history = History.decode(await ledger.history(Listener.NAME))
        assert (history.depth, len(history.blocks)) == (depth, depth + 1)


async def test_a_contract_that_a_reorganisation_took_before_it_was_read_is_left_out(
    place: Place, ledger: Ledger
) -> None:
    diary = Diary()
    listener = Listener(place.chains["robot"], ledger, place.address("robot"), diary)
    await listener._new_liability(NewLiability(place.address("robot"), "0x"))
    assert diary.liabilities == []


class Behind(AsyncBaseProvider):
    """The place's node as one of several behind a balancer: for some calls, it lacks the newest contract."""

    def __init__(self, place: Place) -> None:
        super().__init__()
        self._node = place.node.provider
        self.contract, self.calls = "", 0

    async def make_request(self, method: RPCEndpoint, params: Any) -> RPCResponse:
        if method == "eth_call" and params[0]["to"] == self.contract and self.calls > 0:
            self.calls -= 1
            return {"jsonrpc": "2.0", "id": 1, "result": "0x"}
        return await self._node.make_request(method, params)


async def test_a_node_that_is_behind_loses_no_contract(
    place: Place, ledger: Ledger, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(listener_module, "RETRY", 0.05)
    node = Behind(place)
    robot, ens = place.market.accounts["robot"], place.market.deployment.ens
    async with Chain(node, account=robot, ens=ens, timing=QUICK) as chain:
        await ledger.set_cursor(Listener.NAME, await chain.block_number())
        address, *_ = await contract(place)
        node.contract, node.calls = address, 2
        async with listening(place, ledger, chain=chain) as diary:
            await until(lambda: diary.liabilities)
    assert ([made.address for made, *_ in diary.liabilities], node.calls <= 0) == ([address], True)
