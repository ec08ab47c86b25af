"""A listener, and the diary of what it tells."""

from __future__ import annotations

import secrets
from contextlib import asynccontextmanager
from typing import TYPE_CHECKING

import pytest

from mesh.background import Background
from mesh.work import Ledger
from mesh.work.listener import Listener
from schemas import Demand, Offer, Result
from tests.support.orders import RECORDING, terms
from tests.support.waiting import until_found

if TYPE_CHECKING:
    from collections.abc import AsyncIterator
    from pathlib import Path

    from mesh.chain import Approval, Chain, Transfer
    from schemas import Liability
    from tests.support.market import Place


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
    created = await place.chains["provider"].liabilities.create(deployment.lighthouse_name, demand, offer)
    return created.liability, demand, offer


async def finalize(place: Place, address: str) -> None:
    result = place.market.accounts["robot"].signer.sign(Result(liability=address, result=RECORDING, success=True))
    await place.chains["provider"].liabilities.finalize(place.market.deployment.lighthouse_name, result)
