"""What differs between nodes, as their providers run them: quotas, refused methods, states that they lack."""

from __future__ import annotations

import time
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import pytest
from aiohttp import web

from mesh.chain import Account, Node, NodeUnreachable, RequestRefused, rpc
from mesh.chain._abi import SpoiledAnswer
from mesh.chain._node import GWEI, Fees, GasMarket
from mesh.chain.answers import OverQuota, RpcFailure, decode_answer, decode_revert
from mesh.chain.rpc import secrets_in
from mesh.chain.transactions import within_cap
from mesh.dev import EmbeddedChain
from mesh.dev._rpc import JsonRpcServer
from tests.mesh.chain.conftest import QUICK
from tests.support.node_providers import PROVIDERS, Provider, ProviderServer, error, rows
from tests.support.serving import serving

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

KEY = "9aa3d95b3bc440fa88ea12eaa4456161"


@pytest.fixture
async def embedded() -> AsyncIterator[tuple[EmbeddedChain, str]]:
    async with EmbeddedChain() as chain, JsonRpcServer(chain.provider) as server:
        yield chain, server.url


@pytest.mark.parametrize("name", rows(where=lambda provider: provider.over_quota is not None))
async def test_another_node_is_asked_when_one_is_over_its_quota(embedded: tuple[EmbeddedChain, str], name: str) -> None:
    chain, url = embedded
    always = replace(PROVIDERS[name], refuses=_AlwaysOverQuota(PROVIDERS[name]))
    async with ProviderServer(always, url).serving() as server, Node((server.url, url), timing=QUICK) as node:
        began = time.monotonic()
        account = Account(chain.funded_keys[0])
        assert await node.eth_balance(account.address) > 0
        assert time.monotonic() - began < 5
        assert server.refused


class _AlwaysOverQuota(dict[str, Any]):
    """Refuses every method with the provider's own words."""

    def __init__(self, provider: Provider) -> None:
        super().__init__()
        self._answer = provider.over_quota

    def __contains__(self, method: object) -> bool:
        return True

    def __missing__(self, method: str) -> Any:
        return self._answer


@pytest.mark.parametrize(
    ("code", "message", "data", "wait"),
    [
        (429, "anything", None, 0.0),
        (-32007, "50/second request limit reached", None, 0.0),
        (-32016, "over rate limit", None, 0.0),
        (-32005, "exceeded project rate limit", {"rate": {"backoff_seconds": 1}}, 1.0),
        (-32005, "daily request count exceeded, request rate limited", {"backoff_seconds": "2.5"}, 2.5),
        (-32005, "limit exceeded", None, 0.0),
        (-32000, "Too Many Requests", None, 0.0),
        (-32000, "You have exceeded your plan's monthly credits", None, 0.0),
        (-32005, "rate limited", {"backoff_seconds": "nan"}, 0.0),
    ],
)
def test_an_error_about_a_quota_is_told_from_others(code: int, message: str, data: Any, wait: float) -> None:
    with pytest.raises(OverQuota) as raised:
        decode_answer("eth_call", error(code, message, data))
    assert raised.value.wait == wait


@pytest.mark.parametrize(
    ("code", "message"),
    [
        (-32005, "query returned more than 10000 results"),
        (-32005, "block range too large"),
        (-32602, "eth_getLogs is limited to a 10,000 range"),
        (3, "execution reverted: over quota"),
        (-32000, "gas required exceeds allowance (30000000)"),
        (-32000, "insufficient funds for gas * price + value"),
    ],
)
def test_other_limits_are_no_quota(code: int, message: str) -> None:
    assert isinstance(decode_answer("eth_getLogs", error(code, message)), RpcFailure)


@pytest.mark.parametrize(
    "message", ["header not found", "missing trie node 12ab", "Unknown block", "block #7 not found"]
)
def test_a_machine_that_lacks_a_block_is_asked_again(message: str) -> None:
    with pytest.raises(SpoiledAnswer):
        decode_answer("eth_call", error(-32000, message, "0x"))


async def test_the_wait_that_a_node_asks_for_is_kept() -> None:
    asked: list[float] = []

    async def busy(request: web.Request) -> web.Response:
        asked.append(time.monotonic())
        if len(asked) == 1:
            return web.Response(status=429, headers={"Retry-After": "1"})
        return web.json_response({"jsonrpc": "2.0", "id": (await request.json())["id"], "result": "0x7"})

    async with serving(busy) as url, Node(url, timing=QUICK) as node:
        assert node.chain_id == 7
    assert asked[1] - asked[0] >= 1


async def test_a_refused_pending_state_is_asked_for_once(embedded: tuple[EmbeddedChain, str]) -> None:
    chain, url = embedded
    address = Account(chain.funded_keys[0]).address
    async with ProviderServer(PROVIDERS["nimbus"], url).serving() as server, Node(server.url, timing=QUICK) as node:
        for _ in range(3):
            assert await node.transaction_count(address, block="pending") == 0
        assert server.refused["eth_getTransactionCount"] == 1


async def test_no_error_of_a_node_quotes_the_key_in_its_address(embedded: tuple[EmbeddedChain, str]) -> None:
    refusing = Provider(refuses={"eth_getBalance": error(-32600, f"project {KEY} is not allowed to do that")})
    server = ProviderServer(refusing, embedded[1])
    async with server.serving(), Node(f"{server.url}/?apikey={KEY}", timing=QUICK) as node:
        with pytest.raises(RequestRefused) as refused:
            await node.eth_balance("0x" + "11" * 20)
    assert KEY not in str(refused.value)
    assert "project … is not allowed" in str(refused.value)


def test_the_secret_parts_of_an_address_are_known() -> None:
    assert set(secrets_in(f"https://somebody:{KEY}@node.example/v3/abcdefgh12?key=12345678")) == {
        *("somebody", KEY, "abcdefgh12", "12345678")
    }
    assert secrets_in("http://127.0.0.1:8545") == ()


async def test_nodes_that_stay_over_their_quota_are_named(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(rpc, "QUOTA_PACE", rpc.QUOTA_PACE._replace(patience=0.8, silence=0.2))

    class Full:
        async def make_request(self, method: str, params: Any) -> Any:
            return {"jsonrpc": "2.0", "id": 1} | error(-32005, "daily request count exceeded, request rate limited")

    with pytest.raises(NodeUnreachable) as failed:
        async with Node(Full(), timing=QUICK):
            pass
    assert "over its quota: daily request count exceeded" in failed.value.why
    assert [record.__dict__["event"] for record in caplog.records if record.levelname == "WARNING"] == [
        "node-over-quota"
    ]


@pytest.mark.parametrize(
    ("code", "message"),
    [
        (15, "Too many request, try again later"),
        (-32603, "daily quota of this project is used up"),
        (-32090, "Too many requests, reason: call rate limit exhausted, retry in 10s"),
        (-32005, "You've exceeded the RPS limit available on the current plan"),
        (-32029, "Too many requests on a single connection"),
        (-32097, "request rejected"),
        (-32007, "15/second request limit reached"),
        (429, "capacity exceeded"),
    ],
)
def test_a_quota_is_known_by_its_code_or_its_words(code: int, message: str) -> None:
    with pytest.raises(OverQuota):
        decode_answer("eth_getBalance", error(code, message))


@pytest.mark.parametrize(
    ("method", "code", "message"),
    [
        ("eth_sendRawTransaction", -32005, "Transaction gas limit exceeds block gas limit"),
        ("eth_sendRawTransaction", -32007, "Sender account not authorized to send transactions"),
        ("eth_getLogs", -32005, "limit exceeded"),
        ("eth_getLogs", -32602, "Log response size exceeded. You can request any block range with a cap of 10K logs"),
    ],
)
def test_codes_of_quotas_that_mean_something_else_are_no_quota(method: str, code: int, message: str) -> None:
    assert isinstance(decode_answer(method, error(code, message)), RpcFailure)


def test_a_refusal_of_the_node_is_not_the_contracts() -> None:
    assert decode_revert(RpcFailure(-32000, "not available", "0x1234")) is None
    assert decode_revert(RpcFailure(-32015, "VM execution error.", "Reverted 0x")) is not None
    assert decode_revert(RpcFailure(-32000, "failed", "0x08c379a0")) is not None


def test_an_offer_stays_below_what_nodes_take_as_long_as_it_covers_the_price() -> None:
    base = 70 * GWEI
    market = GasMarket(base + GWEI, Fees(2 * base + GWEI, GWEI))
    fees, limit = within_cap(market.fees, market, 6_600_000)
    assert limit == 7_920_000
    assert base + GWEI <= fees.maximum == 10**18 // limit
    dear = GasMarket(150 * GWEI, Fees(299 * GWEI, GWEI))
    fees, limit = within_cap(dear.fees, dear, 6_600_000)
    assert (fees.maximum, limit) == (150 * GWEI, 10**18 // (150 * GWEI))
    cheap = GasMarket(GWEI, Fees(2 * GWEI, GWEI))
    assert within_cap(cheap.fees, cheap, 21_000) == (cheap.fees, 25_200)


@pytest.mark.parametrize(
    ("method", "refusal"),
    [
        ("eth_getTransactionCount", error(-32601, "the method does not exist")),
        ("eth_estimateGas", error(-32601, "not available on this plan")),
    ],
)
async def test_a_missing_call_is_named_before_work_begins(
    embedded: tuple[EmbeddedChain, str], method: str, refusal: dict[str, Any]
) -> None:
    chain, url = embedded
    address = Account(chain.funded_keys[0]).address
    server = ProviderServer(Provider(refuses={method: refusal}), url)
    async with server.serving(), Node(server.url, timing=QUICK) as node:
        with pytest.raises(RequestRefused, match=method):
            await node.check_calls(address)


async def test_a_block_that_one_machine_lacks_is_asked_for_again(embedded: tuple[EmbeddedChain, str]) -> None:
    class Forgetful:
        asked = 0

        async def make_request(self, method: str, params: Any) -> Any:
            if method == "eth_getBlockByNumber":
                self.asked += 1
                if self.asked == 1:
                    return {"jsonrpc": "2.0", "id": 1, "result": None}
            return await embedded[0].provider.make_request(method, params)

    async with Node(Forgetful(), timing=QUICK) as node:
        assert len(await node.block_hash(0)) == 32
