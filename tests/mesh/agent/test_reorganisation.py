"""What the listener reverts when the chain is reorganised."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import pytest

from mesh.base.background import Background
from mesh.chain import Approval, Chain, ChainWentBack, ContractNames, History, Timing, Transfer
from mesh.testing._market import TIMING
from tests.support.agent.listeners import contract, finalize, ledger, listening, opened, started
from tests.support.waiting import until

if TYPE_CHECKING:
    from mesh.agent.ledger import Ledger
    from tests.support.market import Place

__all__ = ["ledger"]


async def test_a_chain_shorter_than_the_cursor_is_refused(place: Place, ledger: Ledger) -> None:
    await ledger.set_cursor(10**6)
    async with opened(place, ledger) as listener:
        with pytest.raises(ChainWentBack):
            await listener.run()


async def test_a_reverted_finalization_is_reported(place: Place, ledger: Ledger) -> None:
    async with listening(place, ledger) as listener:
        await started(ledger)
        address, *_ = await contract(place)
        await finalize(place, address)
        await until(lambda: listener.ends)
        await place.forget_blocks(1)
        await until(lambda: listener.reverted_ends)
        await finalize(place, address)
        await until(lambda: len(listener.ends) == 2)
    assert listener.reverted_ends == [address]
    assert listener.ends[0][0] == listener.ends[1][0] == address
    assert len(listener.liabilities) == 1, "what came before is as it was"


async def test_a_finalization_reverted_while_the_agent_was_down_is_reported(place: Place, ledger: Ledger) -> None:
    async with listening(place, ledger) as listener:
        await started(ledger)
        address, *_ = await contract(place)
        await finalize(place, address)
        head = await place.chains["robot"].block_number()
        await until(lambda: listener.head >= head)
    await place.forget_blocks(1)
    async with listening(place, ledger) as listener:
        await until(lambda: listener.reverted_ends)
    assert listener.reverted_ends == [address]


async def test_a_new_agent_finds_a_contract_in_a_block_that_replaced_the_one_it_began_at(
    place: Place, ledger: Ledger
) -> None:
    await contract(place)
    before = await place.chains["robot"].block_number()
    await place.node.mine(8)
    async with opened(place, ledger) as listener, Background() as tasks:
        await place.node.request("evm_revert", [hex(before)])
        address, *_ = await contract(place)
        assert await place.chains["robot"].block_number() < before + 8
        await place.node.mine(8)
        tasks.start(listener.run(), "listener")
        await until(lambda: listener.liabilities)
    assert [liability.address for liability, *_ in listener.liabilities] == [address], "no earlier one"


async def test_a_reverted_contract_is_reported_and_again_when_it_is_created(place: Place, ledger: Ledger) -> None:
    async with listening(place, ledger) as listener:
        await started(ledger)
        first, demand, offer = await contract(place)
        await until(lambda: listener.liabilities)
        await place.forget_blocks(1)
        await until(lambda: listener.reverted_contracts)
        lighthouse = place.market.deployment.lighthouse_name
        again = await place.chains["provider"].liabilities.create(lighthouse, demand, offer)
        await until(lambda: len(listener.liabilities) == 2)
    assert listener.reverted_contracts == [first]
    assert [liability.address for liability, *_ in listener.liabilities] == [first, again.liability]
    assert listener.reverted_ends == []


async def test_token_events_and_their_reversions_are_reported(place: Place, ledger: Ledger) -> None:
    person = place.chains["person"]
    async with listening(place, ledger) as listener:
        await started(ledger)
        await person.tokens.approve(place.address("robot"), 11)
        await person.tokens.transfer(place.address("robot"), 12)
        await until(lambda: len(listener.token_events.published) == 2)
        await place.forget_blocks(1)
        await until(lambda: listener.token_events.reverted)
    approval, transfer = listener.token_events.published
    assert isinstance(approval, Approval)
    assert (approval.owner, approval.spender, approval.value) == (place.address("person"), place.address("robot"), 11)
    assert isinstance(transfer, Transfer)
    assert (transfer.sender, transfer.recipient, transfer.value) == (
        place.address("person"),
        place.address("robot"),
        12,
    )
    assert listener.token_events.reverted == [transfer]


async def test_the_history_has_the_depth_of_the_settings_after_they_change(place: Place, ledger: Ledger) -> None:
    for depth in (3, 7, 2):
        timing = Timing(poll_interval=0.03, reorg_depth=depth)
        async with (
            Chain(place.node.provider, contracts=place.market.deployment.contracts, timing=timing) as chain,
            listening(place, ledger, chain=chain) as listener,
        ):
            await started(ledger)
            for _ in range(2 * depth):
                await contract(place)
                head = await chain.block_number()
                await until(lambda listener=listener, head=head: listener.head >= head)  # type: ignore[misc]
        history = History.decode((await ledger.cursor())[1])
        assert (history.depth, len(history.blocks)) == (depth, depth + 1)


class Behind:
    """The place's node as one of several behind a balancer: for some calls, it lacks the newest contract."""

    def __init__(self, place: Place) -> None:
        self._node = place.node.provider
        self.contract, self.calls = "", 0

    async def make_request(self, method: str, params: Any) -> Any:
        if method == "eth_call" and self.calls > 0 and self._is_read(params[0]):
            self.calls -= 1
            return {"jsonrpc": "2.0", "id": 1, "result": "0x"}
        return await self._node.make_request(method, params)

    def _is_read(self, call: dict[str, str]) -> bool:
        """Whether the contract is called, by itself or as one of many."""
        return call.get("to") == self.contract or self.contract[2:].lower() in call["data"]


async def test_a_node_that_is_behind_loses_no_contract(place: Place, ledger: Ledger) -> None:
    node = Behind(place)
    robot, ens = place.market.accounts["robot"], place.market.deployment.ens
    async with Chain(node, account=robot, contracts=ContractNames(ens=ens), timing=TIMING) as chain:
        await ledger.set_cursor(await chain.block_number())
        address, *_ = await contract(place)
        node.contract, node.calls = address, 2
        async with listening(place, ledger, chain=chain) as listener:
            await until(lambda: listener.liabilities)
    assert ([made.address for made, *_ in listener.liabilities], node.calls <= 0) == ([address], True)
