"""A listener that writes down what it reads, and contracts for it to read."""

from __future__ import annotations

import dataclasses
import secrets
from contextlib import asynccontextmanager
from typing import TYPE_CHECKING

import pytest

from mesh.agent._runtime import AgentRuntime, TokenEvents
from mesh.agent.components import working
from mesh.agent.handlers import Handlers
from mesh.agent.ledger import Ledger
from mesh.base.background import Background
from mesh.base.flood import Drops
from mesh.role.models import Models
from schemas import Demand, Offer, Result
from tests.support.orders import RECORDING, terms
from tests.support.waiting import until_found

if TYPE_CHECKING:
    from collections.abc import AsyncIterator
    from pathlib import Path

    from mesh.agent.components import AgentComponents
    from mesh.chain import Approval, Chain, Transfer
    from schemas import Liability
    from tests.support.market import Place


class RecordedTokenEvents(TokenEvents):
    """Token events, those of all accounts, written down instead of published."""

    def __init__(self) -> None:
        super().__init__(lambda key, payload: None, "")
        self.published: list[Transfer | Approval] = []
        self.reverted: list[Transfer | Approval] = []

    def publish(self, event: Transfer | Approval) -> None:
        self.published.append(event)

    def revert(self, event: Transfer | Approval) -> None:
        self.reverted.append(event)


class RecordingListener(AgentRuntime):
    """A listener that writes down what happens on the chain, and does no more about it than to add jobs."""

    def __init__(self, parts: AgentComponents) -> None:
        super().__init__(parts, Handlers(), Models(parts.store, parts.exchange))
        self.watched = self.trader.contracts
        self.liabilities: list[tuple[Liability, bytes, bytes]] = []
        self.ends: list[tuple[str, bool, str]] = []
        self.reverted_ends: list[str] = []
        self.reverted_contracts: list[str] = []
        self.token_events: RecordedTokenEvents = RecordedTokenEvents()
        self.head = 0

    async def run(self) -> None:
        await self._follow_chain()

    async def new_liability(
        self, liability: Liability, *, demand_hash: bytes, offer_hash: bytes, created: int | None = None
    ) -> None:
        self.liabilities.append((liability, demand_hash, offer_hash))
        await self.parts.ledger.add_job(liability)

    async def finalized(self, address: str, *, success: bool, result: str, ended: int | None = None) -> None:
        self.ends.append((address, success, result))

    async def finalization_reverted(self, address: str) -> None:
        self.reverted_ends.append(address)

    async def liability_reverted(self, address: str) -> None:
        self.reverted_contracts.append(address)

    async def on_head(self, block: int) -> None:
        self.head = block


@pytest.fixture
async def ledger(tmp_path: Path) -> AsyncIterator[Ledger]:
    async with Ledger(tmp_path / "ledger.sqlite") as opened:
        yield opened


@asynccontextmanager
async def opened(
    place: Place,
    ledger: Ledger,
    *,
    chain: Chain | None = None,
    kind: type[RecordingListener] = RecordingListener,
) -> AsyncIterator[RecordingListener]:
    """The robot's listener, which does not run yet."""
    settings, account = place.settings("robot"), place.market.accounts["robot"]
    async with working(settings, account, chain or place.chains["robot"], drops=Drops()) as parts:
        if (await ledger.cursor())[0] is None:
            block, history = await parts.ledger.cursor()
            assert block is not None
            await ledger.set_cursor(block, history=history)
        yield kind(dataclasses.replace(parts, ledger=ledger))


@asynccontextmanager
async def listening(place: Place, ledger: Ledger, *, chain: Chain | None = None) -> AsyncIterator[RecordingListener]:
    """The robot's listener at work."""
    async with opened(place, ledger, chain=chain) as listener, Background() as tasks:
        tasks.start(listener.run(), "listener")
        yield listener


async def started(ledger: Ledger) -> None:
    """Wait until a listener has chosen its first block."""

    async def chosen() -> bool:
        return (await ledger.cursor())[0] is not None

    await until_found(chosen)


async def contract(place: Place, *, promisor: str = "robot") -> tuple[str, Demand, Offer]:
    """A liability between the person and the promisor, created by the provider."""
    deployment = place.market.deployment
    fields = terms(token=deployment.xrt, cost=0, lighthouse=deployment.lighthouse, nonce=secrets.token_hex(32))
    demand = place.market.accounts["person"].signer.sign(Demand(**fields, validator_fee=0))
    offer = place.market.accounts[promisor].signer.sign(Offer(**fields, lighthouse_fee=0))
    created = await place.chains["provider"].liabilities.create(deployment.lighthouse_name, demand, offer)
    return created.liability, demand, offer


async def finalize(place: Place, address: str, *, promisor: str = "robot") -> None:
    result = place.market.accounts[promisor].signer.sign(Result(liability=address, result=RECORDING, success=True))
    await place.chains["provider"].liabilities.finalize(place.market.deployment.lighthouse_name, result)
