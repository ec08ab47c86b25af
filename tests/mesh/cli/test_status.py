"""`aira status`: what agents, providers and bridges report."""

from __future__ import annotations

import json
from contextlib import suppress
from typing import TYPE_CHECKING, Any

import msgspec
import pytest

import mesh
from mesh.agent.agent import Agent
from mesh.chain import Chain
from mesh.cli import status as commands
from mesh.cli.status import describe_status, summarize_status
from mesh.dev import JsonRpcServer
from mesh.errors import InvalidAddress
from mesh.network import Endpoints, Network, ServiceFailed
from mesh.settings import Settings
from mesh.validator.validator import Validator
from schemas import RpcKey
from schemas.status import ContentMetrics, MarketStatus, Status, StoreUse, ValidationStatus, Work
from tests.mesh.watching.test_presence import WAY, bridge_status, status
from tests.support.cli.served_chain import columns
from tests.support.commands import coroutine
from tests.support.market import MODEL, offering, offering_unseen
from tests.support.objectives import objective
from tests.support.orders import MARKET, OBJECTIVE, ROBOT, STRANGER
from tests.support.provider.local_market import QUICK
from tests.support.raising import raises_with
from tests.support.waiting import until_answered, until_found

if TYPE_CHECKING:
    from tests.support.market import Place
    from tests.support.routers import EmbeddedRouter

WORK = Work(
    jobs={"ready": 2, "running": 1, "finalized": 12_345},
    outbox=1,
    store=StoreUse(files=3, bytes=2048, quota=10 * 1024**3),
)
MARKET_FACTS = MarketStatus(
    open_orders=7,
    created=3,
    finalized=2,
    rejected={"expired": 2, "WrongSigner": 1},
    gas_used=343_444,
    spent=2 * 10**15,
    fees=10**9,
    minted=5 * 10**8,
)


VALIDATION = ValidationStatus(
    validators=(STRANGER.address, ROBOT.address),
    policies=("complete", "rate"),
    fee=10**8,
    cases={"waiting": 2, "judging": 0, "signed": 1, "ended": 1_234},
    store=StoreUse(files=3, bytes=2048, quota=10 * 1024**3),
)


async def read_status(place: Place, role: str, capsys: pytest.CaptureFixture[str]) -> dict[str, Any]:
    """The status of a role as `aira status --json` prints it."""
    async with Network(Endpoints(connect=(place.endpoint,))) as network:
        await until_answered(network.session, str(RpcKey(place.address(role), "status")))
    await coroutine(commands.status)(place.settings("watcher"), place.address(role), timeout=60.0, as_json=True)
    (found,) = json.loads(capsys.readouterr().out)
    assert isinstance(found, dict)
    return found


async def test_a_validator_reports_its_parts_and_its_cases(place: Place, capsys: pytest.CaptureFixture[str]) -> None:
    account, chain = place.market.accounts["person"], place.chains["person"]
    validator = Validator(settings=place.settings("judge"), account=account, chain=chain, fee="0.1 XRT")
    async with validator:
        found = await read_status(place, "person", capsys)
    assert found["role"] == "validator"
    assert found["parts"] == dict.fromkeys(("channel", "listener"), "alive")
    assert found["validation"]["validators"] == [place.address("person")]
    assert (found["validation"]["policies"], found["validation"]["fee"]) == (["complete"], "100000000")


def test_a_validator_is_described_for_people() -> None:
    judge = msgspec.structs.replace(status(role="validator"), validation=VALIDATION)
    shown = describe_status(judge)
    assert shown["judges for"] == f"{STRANGER.address}, {ROBOT.address}"
    assert shown["open cases"] == "2 waiting, 1 signed"
    assert (shown["done"], shown["fee"], shown["policies"]) == ("1,234", "0.1 XRT", "complete, rate")
    assert summarize_status(judge).endswith("3 open cases")


async def test_an_agent_reports_its_parts_its_block_and_its_work(
    place: Place, capsys: pytest.CaptureFixture[str]
) -> None:
    async with place.at_work(offering(place.agent("robot"))) as person:
        contract = await person.demand(place.save(objective(("/go", "x"))), cost=1)

        async def is_ready() -> bool:
            jobs: dict[str, int] = (await read_status(place, "robot", capsys))["work"]["jobs"]
            return jobs == {"ready": 1}

        await until_found(is_ready, what="the job", seconds=30)
        found = await read_status(place, "robot", capsys)
        head = await place.chains["person"].block_number()
    assert found["parts"] == dict.fromkeys(("executor", "channel", "signer", "listener"), "alive")
    assert (found["role"], found["address"], found["version"]) == ("agent", place.address("robot"), mesh.__version__)
    assert found["lighthouse"] == place.market.deployment.lighthouse_name
    assert found["xrt"] == place.market.deployment.xrt
    assert 0 < found["head"] <= head
    assert found["work"]["store"]["files"] == 1
    assert contract.liability.promisor == found["address"]


async def test_an_open_order_is_counted_in_the_outbox(place: Place, capsys: pytest.CaptureFixture[str]) -> None:
    async with place.agent("robot") as robot:
        assert (await read_status(place, "robot", capsys))["work"]["outbox"] == 0
        await robot.offer(objective=OBJECTIVE)
        assert (await read_status(place, "robot", capsys))["work"]["outbox"] == 1


async def test_a_disabled_executor_is_reported_as_off(place: Place, capsys: pytest.CaptureFixture[str]) -> None:
    async with place.agent("robot", enable_executor=False):
        found = await read_status(place, "robot", capsys)
    assert found["parts"]["executor"] == "off"
    assert summarize_status(Status.decode(json.dumps(found).encode())).startswith("alive, block ")


async def test_a_part_that_waits_for_the_node_says_so(place: Place, capsys: pytest.CaptureFixture[str]) -> None:
    async with JsonRpcServer(place.node.provider) as server:
        account = place.market.accounts["robot"]
        chain = Chain(server.url, account=account, contracts=place.market.deployment.contracts, timing=QUICK)
        async with chain, Agent(MODEL, settings=place.settings("robot"), account=account, chain=chain):
            assert (await read_status(place, "robot", capsys))["parts"]["listener"] == "alive"
            await server.__aexit__(None, None, None)

            async def waits() -> bool:
                state: str = (await read_status(place, "robot", capsys))["parts"]["listener"]
                return state == "waits for the node"

            await until_found(waits, what="the loss", seconds=60)
            assert (await read_status(place, "robot", capsys))["parts"]["channel"] == "alive"


async def test_a_provider_reports_its_orders_and_earnings(place: Place, capsys: pytest.CaptureFixture[str]) -> None:
    async with place.at_work(offering_unseen(place.agent("robot"))) as person:
        await person.demand(place.save(objective(("/go", "x"))), cost=1)

        async def has_created() -> bool:
            market = (await read_status(place, "provider", capsys))["market"]
            return bool(market["created"] and not market["openOrders"])

        await until_found(has_created, what="the contract in the provider's count", seconds=60)
        found = await read_status(place, "provider", capsys)
        await coroutine(commands.status)(
            place.settings("watcher"), place.address("provider"), timeout=60.0, as_json=False
        )
        shown = columns(capsys.readouterr().out)
    assert (found["role"], found["market"]["created"], found["market"]["openOrders"]) == ("provider", 1, 0)
    assert int(found["market"]["spent"]) > 0
    assert shown["contracts"].startswith("1 created")
    assert (shown["provider"], shown["listener"]) == (place.address("provider"), "alive")


async def test_each_peer_on_the_lighthouse_has_a_line(place: Place, capsys: pytest.CaptureFixture[str]) -> None:
    async with place.at_work(place.agent("robot")):

        async def all_there() -> bool:
            await coroutine(commands.status)(place.settings("watcher"), None, timeout=60.0, as_json=True)
            people = json.loads(capsys.readouterr().out)["peers"]
            return len(people) == 3 and all(person["status"] for person in people)

        await until_found(all_there, what="three peers", seconds=30)
        await coroutine(commands.status)(place.settings("watcher"), None, timeout=60.0, as_json=False)
    head, *rows = capsys.readouterr().out.splitlines()
    assert head.split() == ["role", "address", "status"]
    assert sorted(row.split()[0] for row in rows) == ["agent", "agent", "provider"]
    assert all("  alive, block " in row for row in rows)


async def test_a_peer_that_does_not_answer_is_listed(place: Place, capsys: pytest.CaptureFixture[str]) -> None:
    async with place.agent("robot") as robot:
        robot.channel.announce("person", STRANGER.address)

        async def is_there() -> bool:
            await coroutine(commands.status)(place.settings("watcher"), None, timeout=60.0, as_json=False)
            return f"person  {STRANGER.address}  no answer\n" in capsys.readouterr().out

        await until_found(is_there, what="the silent one", seconds=30)


@pytest.mark.parametrize("number", [b"1e308", b"-1e308", b"1" + b"0" * 4000, b"18446744073709551616", b"-1e18"])
@pytest.mark.parametrize("field", [b'"uptime":0.0', b'"head":7', b'"chainId":1'])
async def test_a_stranger_with_strange_numbers_is_shown_or_has_not_answered(
    router: EmbeddedRouter, capsys: pytest.CaptureFixture[str], number: bytes, field: bytes
) -> None:
    settings, key = Settings(connect=(router.endpoint,)), str(RpcKey(STRANGER.address, "status"))
    reply = status(address=STRANGER.address).encode()
    assert field in reply
    strange = reply.replace(field, field.partition(b":")[0] + b":" + number)
    async with Network(Endpoints(connect=(router.endpoint,))) as network:
        answering: Any = network.session.declare_queryable(key, lambda query: query.reply(key, strange))
        await until_answered(network.session, key)
        for as_json in (False, True):
            with suppress(ServiceFailed):
                await coroutine(commands.status)(settings, STRANGER.address, timeout=1.0, as_json=as_json)
        answering.undeclare()
    assert len(capsys.readouterr().out) < 3000


async def test_a_missing_peer_is_one_clear_line(router: EmbeddedRouter, capsys: pytest.CaptureFixture[str]) -> None:
    settings = Settings(connect=(router.endpoint,))
    with raises_with(ServiceFailed, code="no-answer", match=STRANGER.address):
        await coroutine(commands.status)(settings, STRANGER.address, timeout=1.0, as_json=False)
    with pytest.raises(InvalidAddress):
        await coroutine(commands.status)(settings, "robot", timeout=1.0, as_json=False)
    await coroutine(commands.status)(settings, None, timeout=1.0, as_json=False)
    assert capsys.readouterr().out == f"no peers on {MARKET}\n"


def test_the_work_of_an_agent_is_described() -> None:
    shown = describe_status(msgspec.structs.replace(status(), work=WORK, uptime=75.5))
    assert shown["agent"] == ROBOT.address
    assert (shown["open jobs"], shown["done"]) == ("2 ready, 1 running", "12,345")
    assert (shown["to send"], shown["store"]) == ("1 message", "3 files, 2.0 KiB of 10.0 GiB")
    assert (shown["block"], shown["uptime"]) == ("7 of chain 1", "75 s")


def test_the_market_of_a_provider_is_described() -> None:
    shown = describe_status(msgspec.structs.replace(status(role="provider"), market=MARKET_FACTS))
    assert shown["contracts"] == "3 created, 2 finalized"
    assert shown["rejected"] == "3 (1 WrongSigner, 2 expired)"
    assert shown["earned"] == "1.5 XRT, including 1 XRT of fees"
    assert shown["spent"] == "0.002 ETH for 343,444 gas"


def test_what_was_dropped_is_shown_with_its_heaviest_senders_and_absent_in_older_records() -> None:
    older = json.loads(status().encode())
    del older["dropped"], older["heaviest"]
    read = Status.decode(json.dumps(older).encode())
    assert "dropped" not in describe_status(read)

    flooded = msgspec.structs.replace(
        read, dropped={"too-large": 1200, "unfunded": 7}, heaviest={"unfunded": {ROBOT.address: 5}}
    )
    shown = describe_status(Status.decode(flooded.encode()))
    assert shown["dropped"] == "1,207 (1,200 too-large, 7 unfunded)"
    assert shown["most unfunded"] == f"{ROBOT.address} 5"


def test_a_bridge_is_described() -> None:
    way = msgspec.structs.replace(WAY, carried=12, per_second=0.5, dropped={"no-room": 3}, waiting=4)
    shown = describe_status(msgspec.structs.replace(bridge_status(), to_ipfs=way, last_error="refused", losses=2))
    assert (shown["bridge"], shown["state"], shown["active"]) == (STRANGER.address, "alone", "yes")
    assert shown["to IPFS"] == "12 relayed (0.5/s), 4 waiting, 3 (3 no-room) dropped"
    assert (shown["daemon losses"], shown["last error"]) == ("2", "refused")
    assert "content" not in shown
    counters = dict.fromkeys(ContentMetrics.__struct_fields__, 0) | {"fetched": 2, "fetched_bytes": 2048, "lies": 1}
    content = describe_status(msgspec.structs.replace(bridge_status(), content=ContentMetrics(**counters)))["content"]
    assert (
        content
        == "2 files fetched (2.0 KiB), 0 added (0 bytes), 0 blocks served, 1 invalid ones rejected, 0 queued, 0 failed"
    )


def test_a_summary_begins_with_the_part_that_is_not_alive() -> None:
    ill = msgspec.structs.replace(status(), parts={"channel": "alive", "listener": "waits for the node"}, work=WORK)
    assert summarize_status(ill) == "listener waits for the node, block 7, 3 open jobs"
    assert summarize_status(msgspec.structs.replace(status(), market=MARKET_FACTS)) == (
        "alive, block 7, 7 open orders, 3 contracts"
    )
    assert summarize_status(bridge_status()) == "alone, active, 0 nodes on the IPFS side"


def test_control_characters_of_a_status_are_not_printed() -> None:
    evil = msgspec.structs.replace(status(), parts={"\x1b[2J": "\x1b[2J"}, version="\x1b]0;x\x07")
    shown = f"{describe_status(evil)} {summarize_status(evil)}"
    assert "\x1b" not in "".join(f"{name}{fact}" for name, fact in describe_status(evil).items()) + summarize_status(
        evil
    )
    assert "\ufffd" in shown
