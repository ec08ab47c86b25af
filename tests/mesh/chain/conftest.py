"""Chains with the contracts on them, for the tests of `mesh.chain`.

One chain serves all tests of a module; tests make orders of their own and compare balances, not absolute numbers.
"""

from __future__ import annotations

import asyncio
import re
from contextlib import aclosing, contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypeVar

import pytest
import pytest_asyncio

from mesh.chain import (
    XRT,
    Account,
    Chain,
    Deployment,
    DeploymentPlan,
    NoContracts,
    Node,
    NodeUnreachable,
    Reverted,
    Timing,
    deploy,
)
from mesh.dev import EmbeddedChain
from mesh.dev._embedded import EmbeddedProvider
from schemas import keccak256
from schemas.address import ZERO_ADDRESS
from schemas.cid import cid_of_digest
from schemas.messages import Demand, Offer, Result
from tests.support.market import contracts_in
from tests.support.nodes import Anvil

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Iterator

    from mesh.chain import BlockEvents, ChainEvent
    from mesh.chain.rpc import Transport

E = TypeVar("E", bound=Exception)

QUICK = Timing(
    poll_interval=0.02, receipt_interval=0.01, attempts=2, retry_delay=0.01, receipt_timeout=30, first_timeout=15
)
PLAN = DeploymentPlan(refund_delay=10, timeout_blocks=5)


def cid(seed: int) -> str:
    """A CID of nothing, different for each seed."""
    return cid_of_digest(keccak256(seed.to_bytes(32, "big")))


@dataclass(frozen=True)
class DeployedMarket:
    """A deployment with a staked provider, a promisee and a promisor, who all approved the factory."""

    endpoint: str | Transport
    deployment: Deployment
    deployer: Account
    provider: Account
    promisee: Account
    promisor: Account
    stranger: Account

    def chain(self, account: Account | None = None, **options: Any) -> Chain:
        contracts = contracts_in(options)
        return Chain(self.endpoint, account=account, contracts=contracts, **({"timing": QUICK} | options))

    def demand(self, account: Account | None = None, **fields: Any) -> Demand:
        """A signed demand of the promisee's, of generation 5 where `sender` is given."""
        account = account or self.promisee
        demand = Demand(**(self._terms() | {"validator_fee": 0} | fields))
        return account.signer.sign(demand)

    def offer(self, account: Account | None = None, **fields: Any) -> Offer:
        """A signed offer of the promisor's that matches `demand` with the same fields."""
        account = account or self.promisor
        return account.signer.sign(Offer(**(self._terms() | {"lighthouse_fee": 0} | fields)))

    def result(self, liability: str, *, account: Account | None = None, **fields: Any) -> Result:
        """The promisor's signed result."""
        terms: dict[str, Any] = {"liability": liability, "result": cid(3), "success": True}
        return (account or self.promisor).signer.sign(Result(**(terms | fields)))

    def _terms(self) -> dict[str, Any]:
        return {
            "model": cid(1),
            "objective": cid(2),
            "token": self.deployment.xrt,
            "cost": 0,
            "lighthouse": self.deployment.lighthouse,
            "validator": ZERO_ADDRESS,
            "deadline": 1_000_000,
            "nonce": next_nonce(),
        }


_used = 0


def next_nonce() -> str:
    """A generation-3 nonce that no order of this run has had."""
    global _used
    _used += 1
    return keccak256(b"nonce" + _used.to_bytes(8, "big")).hex()


async def prepare(endpoint: str | Transport, keys: tuple[bytes, ...]) -> DeployedMarket:
    """Deploy everything; stake the provider; give promisee and promisor XRT, and let the factory take it."""
    deployer, provider, promisee, promisor, stranger = (Account(key) for key in keys[:5])
    async with Node(endpoint, timing=QUICK) as node:
        market = DeployedMarket(
            endpoint, await deploy(node, deployer, plan=PLAN), deployer, provider, promisee, promisor, stranger
        )
        async with Chain(node, account=deployer) as chain:
            for account in (provider, promisee, promisor):
                await chain.tokens.transfer(account.address, 1000 * XRT)
        for account, spender in ((promisee, "factory"), (promisor, "factory"), (provider, "lighthouse")):
            async with Chain(node, account=account) as chain:
                await chain.tokens.approve(getattr(market.deployment, spender), 1000 * XRT)
        async with Chain(node, account=provider) as chain:
            await chain.lighthouses.refill(market.deployment.lighthouse, 500 * XRT)
    return market


async def read_to(chain: Chain, first: int, last: int) -> list[BlockEvents]:
    """The events of the blocks from `first` to `last`."""
    blocks: list[BlockEvents] = []
    async with asyncio.timeout(60), aclosing(chain.follow(first)) as events:
        async for block in events:
            blocks.append(block)
            if block.block_number >= last:
                break
    return blocks


def events_of(blocks: list[BlockEvents]) -> list[ChainEvent]:
    return [event for block in blocks for event in block.events]


@contextmanager
def reverted(reason: str) -> Iterator[pytest.ExceptionInfo[Reverted]]:
    """Expect that a contract refuses for a reason."""
    with pytest.raises(Reverted) as caught:
        yield caught
    assert caught.value.reason == reason


@contextmanager
def unreachable(why: str) -> Iterator[pytest.ExceptionInfo[NodeUnreachable]]:
    """Expect that no node answers; `why` is in the error's reason or its endpoint."""
    with pytest.raises(NodeUnreachable) as caught:
        yield caught
    assert re.search(why, f"{caught.value.endpoint} {caught.value.why}")


@contextmanager
def no_contracts(what: str) -> Iterator[pytest.ExceptionInfo[NoContracts]]:
    """Expect that the chain lacks something whose description contains `what`."""
    with pytest.raises(NoContracts) as caught:
        yield caught
    assert what in caught.value.what


class Flaky(EmbeddedProvider):
    """An embedded chain behind a wire that can be cut."""

    is_lost = False
    asked = 0

    async def make_request(self, method: str, params: Any) -> Any:
        self.asked += 1
        if self.is_lost:
            raise ConnectionError("the wire is cut")
        return await super().make_request(method, params)


class OneAtATime:
    """A node that takes one transaction, and refuses the next ones as geth does above its cap, until `allow`."""

    def __init__(self, upstream: Any) -> None:
        self._upstream = upstream
        self.taken = 0
        self._allowed = 0

    def allow(self) -> None:
        self._allowed = self.taken + 1

    async def make_request(self, method: str, params: Any) -> Any:
        if method == "eth_sendRawTransaction":
            if self.taken == self._allowed:
                refusal = {"code": -32000, "message": "tx fee (1.21 ether) exceeds the configured cap (1.00 ether)"}
                return {"jsonrpc": "2.0", "id": 1, "error": refusal}
            self.taken += 1
        return await self._upstream.make_request(method, params)


@pytest_asyncio.fixture(scope="module", loop_scope="module", params=["embedded", "anvil"])
async def market(request: pytest.FixtureRequest) -> AsyncIterator[DeployedMarket]:
    """A market on the embedded chain and on anvil."""
    if request.param == "embedded":
        async with EmbeddedChain() as node:
            yield await prepare(node.provider, node.funded_keys)
    else:
        async with Anvil() as anvil:
            yield await prepare(anvil.url, anvil.private_keys)
