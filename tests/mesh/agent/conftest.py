"""Markets for the tests of this folder, and programs that ask agents for something."""

from __future__ import annotations

from contextlib import asynccontextmanager
from typing import TYPE_CHECKING, Any

import pytest

from mesh.chain import TransactionSender
from mesh.chain._contracts import ContractVersion
from mesh.network import Endpoints, Network, ServiceFailed, call
from schemas.rpc import Nothing

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    from mesh.agent.agent import Agent
    from mesh.chain import Chain
    from schemas import Record
    from tests.support.market import Place


async def other_token(chain: Chain, *, supply: int) -> str:
    """The address of a token, XRT in all but its name, of which the account of the chain has all."""
    assert chain.account is not None
    data = chain.node.creation_code("XRT", supply)
    receipt = await TransactionSender(chain.node, chain.account).send(to=None, data=data)
    assert receipt.contract is not None
    return receipt.contract


class Asker:
    """A program on the same router, which has no account."""

    def __init__(self, network: Network, agent: Agent) -> None:
        self._network = network
        self.agent = agent

    async def ask(self, service: str, request: Record | None = None) -> Any:
        return await call(self._network.session, self.agent.address, service, request or Nothing())

    async def refused(self, service: str, request: Record) -> str:
        """The line with which a request is refused, which has a hint."""
        with pytest.raises(ServiceFailed) as caught:
            await self.ask(service, request)
        assert "\n" not in str(caught.value)
        return str(caught.value).removeprefix(f"{service}: ") + " / " + caught.value.hint


@asynccontextmanager
async def asking(place: Place, agent: Agent) -> AsyncIterator[Asker]:
    async with agent, Network(Endpoints(connect=(place.endpoint,))) as network:
        yield Asker(network, agent)


@pytest.fixture
async def person(place: Place) -> AsyncIterator[Agent]:
    """The person's agent at work."""
    async with place.agent("person") as person:
        yield person


@pytest.fixture
async def opened(place: Place) -> AsyncIterator[Asker]:
    """The robot with services that are open to all."""
    async with asking(place, place.agent("robot", open_services=True)) as asker:
        yield asker


@pytest.fixture
def without_permits(monkeypatch: pytest.MonkeyPatch) -> None:
    """As with contracts, or tokens, that know no permits: agents approve what their orders may cost."""
    monkeypatch.setattr(ContractVersion, "takes_permits", False)
