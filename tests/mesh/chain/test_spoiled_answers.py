"""Answers of a real node that a proxy spoils: a null, a missing field, another type, or only the beginning."""

from __future__ import annotations

import asyncio
from contextlib import AsyncExitStack, suppress
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import pytest
import pytest_asyncio
from aiohttp import web

from mesh.chain import Chain, NoContracts, Node, NodeUnreachable, RequestRefused, TransactionSender
from mesh.chain._contracts import LIGHTHOUSE_LIMITS
from mesh.chain.answers import ANSWER_LIMITS, ANSWERS, InvalidAnswer
from mesh.errors import AiraError
from tests.mesh.chain.conftest import QUICK, prepare
from tests.support.chain.senders import unused_address
from tests.support.nodes import Anvil
from tests.support.serving import serving
from tests.support.spoiling import KINDS, SpoilingProxy

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Awaitable, Callable

    from tests.mesh.chain.conftest import DeployedMarket

PATIENT = replace(QUICK, attempts=10)
ALWAYS = 1.0


@pytest_asyncio.fixture(scope="module", loop_scope="module")
async def anvil() -> AsyncIterator[Anvil]:
    async with Anvil() as anvil:
        yield anvil


@pytest_asyncio.fixture(scope="module", loop_scope="module")
async def market(anvil: Anvil) -> DeployedMarket:
    return await prepare(anvil.url, anvil.private_keys)


async def _everything(chain: Chain) -> None:
    """A use of each method."""
    node, account = chain.node, chain.account
    assert account is not None
    receipt = await TransactionSender(node, account).send(to=unused_address(), data=b"", value=1)
    assert await node.receipt(receipt.tx)
    assert await node.has_transaction(receipt.tx)
    await node.block_number()
    await node.client_version()
    await node.is_syncing()
    await node.gas_price()
    await chain.tokens.eth_balance()
    await chain.tokens.supply()
    await chain.tokens.unit()
    await chain.lighthouses.list()
    assert await chain.has_mesh_contracts()
    assert await node.block_hash(0)
    made = await chain.validators.deploy([account.address, unused_address()], 2)
    jury = await chain.validators.jury(made.address)
    assert jury is not None
    assert (jury.jurors, jury.quorum) == (made.jurors, 2)
    assert await chain.validators.accepts(made.address, account.address)


FOR_DOUBTS = ("eth_getBlockByHash", "eth_getBlockReceipts")
"""What is asked only where an empty answer about logs is doubted."""


@pytest.mark.in_turn("nodes")
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("nodes", [1, 2])
async def test_each_method_is_asked_again_after_a_spoiled_answer(
    market: DeployedMarket, anvil: Anvil, kind: str, nodes: int
) -> None:
    """A third of the answers of each method is spoiled. With two nodes, the next one is asked."""
    wanted, spoiled = ANSWERS.keys() - {"eth_chainId", *FOR_DOUBTS}, set[str]()
    for seed in range(20):
        async with AsyncExitStack() as stack:
            proxies = [
                await stack.enter_async_context(SpoilingProxy(anvil.url, seed=seed + 10 * n, rate=0.0, kinds=(kind,)))
                for n in range(nodes)
            ]
            urls = [proxy.url for proxy in proxies]
            chain = await stack.enter_async_context(
                Chain(urls, account=market.stranger, contracts=market.deployment.contracts, timing=PATIENT)
            )
            for proxy in proxies:
                proxy.rate = 0.3
            for _ in range(3):
                chain.node._priority = 0.0, 0  # or it is asked for once a minute
                # A null is what a node says of a block or a transaction that it does not have.
                with suppress(*((NodeUnreachable, AssertionError) if kind == "null" else ())):
                    await _everything(chain)
                with suppress(NodeUnreachable):  # a null of what comes before may have ended all of it
                    await chain.has_mesh_contracts()
            spoiled |= {method for proxy in proxies for method, _ in proxy.spoiled}
        if seed >= 3 and spoiled >= wanted:
            break
    assert spoiled >= wanted


async def test_a_node_that_says_it_has_no_latest_block_is_asked_again(anvil: Anvil) -> None:
    """Every chain has one, so a null is a spoiled answer."""
    spoiling: dict[str, Any] = {"methods": frozenset({"eth_getBlockByNumber"}), "kinds": ("null",), "rate": 0.5}
    async with SpoilingProxy(anvil.url, seed=1, **spoiling) as proxy, Node(proxy.url, timing=PATIENT) as node:
        for _ in range(20):
            await node.heads.look()
        assert proxy.spoiled.total()


async def test_a_permit_is_signed_through_a_node_that_at_times_lacks_the_contracts(
    market: DeployedMarket, anvil: Anvil
) -> None:
    """What several functions return comes in one answer, which is asked for again if it is empty."""
    emptying: dict[str, Any] = {"methods": frozenset({"eth_call"}), "kinds": ("emptied",), "rate": 0.0}
    async with SpoilingProxy(anvil.url, seed=1, **emptying) as proxy:
        async with Chain(
            proxy.url, account=market.stranger, contracts=market.deployment.contracts, timing=PATIENT
        ) as chain:
            proxy.rate = 0.1
            for value in range(1, 21):
                assert await chain.permits.sign(chain.xrt, value) is not None
        assert proxy.spoiled.total()


@pytest.mark.in_turn("kind")
@pytest.mark.parametrize("method", ANSWERS)
@pytest.mark.parametrize("kind", KINDS)
async def test_a_node_that_spoils_every_answer_to_a_method_is_unreachable(
    market: DeployedMarket, anvil: Anvil, method: str, kind: str
) -> None:
    """What is raised is an error of the mesh, and the same request to a sound node succeeds."""
    timing = replace(QUICK, attempts=1, receipt_timeout=0.3)
    async with SpoilingProxy(anvil.url, seed=1, rate=0.0, methods=frozenset({method}), kinds=(kind,)) as proxy:
        async with Chain(
            proxy.url, account=market.stranger, contracts=market.deployment.contracts, timing=timing
        ) as chain:
            proxy.rate = ALWAYS
            for use in _uses(chain):
                with suppress(AiraError):
                    await use()
            assert proxy.spoiled[method, kind]
        async with Chain(
            [proxy.url, anvil.url],
            account=market.stranger,
            contracts=market.deployment.contracts,
            timing=QUICK,
        ) as chain:
            await chain.tokens.balance()


def _uses(chain: Chain) -> list[Callable[[], Awaitable[Any]]]:
    node, account = chain.node, chain.account
    assert account is not None
    nobody = unused_address()

    async def logs_by_receipts() -> None:
        await node._logs_by_receipts(await node.heads.look())

    return [
        logs_by_receipts,
        lambda: TransactionSender(node, account).send(to=nobody, data=b"", value=1),
        lambda: node.receipt("0x" + "00" * 32),
        lambda: node.has_transaction("0x" + "00" * 32),
        node.block_number,
        node.client_version,
        node.is_syncing,
        node.gas_price,
        chain.tokens.eth_balance,
        chain.tokens.supply,
        chain.lighthouses.list,
        chain.has_mesh_contracts,
        lambda: node.block_hash(0),
        node.gas_market,
        lambda: node.request("eth_chainId"),
    ]


@pytest.mark.parametrize(
    "body",
    [b'{"jsonrpc":"2.0","id":1,"result":' + b"[" * 100_000, b"{" * 100_000, b'{"jsonrpc":"2.0","id":1}', b'{"id":'],
    ids=["deep", "braces", "no result", "cut off"],
)
async def test_an_answer_that_is_not_json_to_the_end_is_asked_for_again(body: bytes) -> None:
    count = 0

    async def hesitant(request: web.Request) -> web.Response:
        nonlocal count
        count += 1
        return web.Response(body=body if count < 3 else b'{"jsonrpc":"2.0","id":1,"result":"0x7"}')

    async with serving(hesitant) as url, Node(url, timing=replace(QUICK, attempts=3)) as node:
        assert node.chain_id == 7


async def test_an_answer_without_end_is_cut_off() -> None:
    sent = 0

    async def endless(request: web.Request) -> web.StreamResponse:
        nonlocal sent
        response = web.StreamResponse()
        await response.prepare(request)
        with suppress(ConnectionError):
            while sent < 4 * ANSWER_LIMITS.size:
                await response.write(bytes(1 << 20))
                sent += 1 << 20
        return response

    async with serving(endless) as url:
        with pytest.raises(NodeUnreachable):
            async with Node(url, timing=replace(QUICK, attempts=1)):
                pass
    assert sent < 2 * ANSWER_LIMITS.size


@pytest.mark.parametrize("count", [2**256 - 1, LIGHTHOUSE_LIMITS.providers + 1])
async def test_a_lighthouse_that_states_too_many_providers_is_not_read(market: DeployedMarket, count: int) -> None:
    """A contract that answers everything with one number."""
    code = "7f" + count.to_bytes(32, "big").hex() + "60005260206000f3"
    liar = unused_address()
    async with market.chain(ens=market.deployment.ens) as chain:
        await chain.node.request("anvil_setCode", liar, "0x" + code)
        with pytest.raises(RequestRefused) as caught:
            await asyncio.wait_for(chain.lighthouses.get(liar), 60)
        assert caught.value.code == "invalid-answer"


@pytest.mark.parametrize("digits", ["", "00", "ff" * 32, "ff" * 31, "00" * 64])
async def test_what_does_not_decode_is_an_error(market: DeployedMarket, digits: str) -> None:
    """A contract that answers everything with the same bytes."""
    liar = unused_address()
    size = len(digits) // 2
    code = "".join(f"60{byte:02x}60{at:02x}53" for at, byte in enumerate(bytes.fromhex(digits))) + f"60{size:02x}6000f3"
    async with market.chain() as chain:
        await chain.node.request("anvil_setCode", liar, "0x" + code)
        for name in ("Liability", "Lighthouse", "XRT"):
            functions = chain.node.contract(name, liar)
            for function in functions:
                if function.inputs or not function.outputs:
                    continue
                with suppress(InvalidAnswer, NoContracts):
                    await chain.node.read(function.at(liar))
