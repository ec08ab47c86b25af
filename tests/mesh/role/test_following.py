"""Following the chain as a role does. With a stored cursor: see the tests of the agent's listener and of validators."""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING

import pytest

from mesh.base.background import Background
from mesh.base.outage_log import OutageLog
from mesh.chain import NewLiability, NotALiability
from mesh.role.following import ChainHead, follow_chain
from tests.support.agent.listeners import contract
from tests.support.waiting import until

if TYPE_CHECKING:
    from mesh.chain import ChainEvent
    from mesh.role.following import Created
    from tests.support.market import Place


class Provider:
    """A role without a store, which writes down what it is told; `fails` times it can't read a liability."""

    def __init__(self, place: Place, head: int) -> None:
        self.chain, self.head = place.chains["provider"], ChainHead(head)
        self.created: list[tuple[str, int]] = []
        self.reverted: list[str] = []
        self.reorganisations = self.fails = 0

    async def run(self) -> None:
        await follow_chain(self, self.chain, self.head, OutageLog(logging.getLogger("test"), "chain"))

    async def on_event(self, event: ChainEvent, created: Created | None, block: int) -> None:
        if isinstance(event, NewLiability):
            assert created is not None
            if self.fails > 0:
                self.fails -= 1
                raise NotALiability(event.liability)
            self.created.append((created[0].address, block))

    async def on_revert(self, event: ChainEvent) -> None:
        if isinstance(event, NewLiability):
            self.reverted.append(event.liability)

    async def on_reorganised(self, block: int) -> None:
        self.reorganisations += 1

    async def on_head(self, block: int) -> None:
        assert self.head.head == block


@pytest.fixture
async def provider(place: Place) -> Provider:
    return Provider(place, await place.chains["provider"].block_number())


async def test_a_role_without_a_store_begins_after_its_head(place: Place) -> None:
    await contract(place)
    role = Provider(place, await place.chains["provider"].block_number())
    async with Background() as tasks:
        tasks.start(role.run(), "role")
        address, *_ = await contract(place)
        await until(lambda: role.created)
        assert role.created == [(address, await role.chain.block_number())]


async def test_what_can_not_be_read_now_is_handled_again(place: Place, provider: Provider) -> None:
    provider.fails = 2
    async with Background() as tasks:
        tasks.start(provider.run(), "role")
        address, *_ = await contract(place)
        await until(lambda: provider.created)
    assert ([made for made, _ in provider.created], provider.fails) == ([address], 0)


async def test_a_block_that_was_handled_in_part_is_reverted(place: Place, provider: Provider) -> None:
    """The role fails on what the chain then replaces."""
    provider.fails = 10**6
    async with Background() as tasks:
        tasks.start(provider.run(), "role")
        first, *_ = await contract(place)
        await until(lambda: provider.fails < 10**6)
        await place.forget_blocks(1)
        second, *_ = await contract(place)
        await until(lambda: provider.reverted)
        provider.fails = 0
        await until(lambda: provider.created)
    assert (provider.reverted, provider.reorganisations) == ([first], 1)
    assert [made for made, _ in provider.created] == [second]
