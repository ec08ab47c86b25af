"""A malicious model over a real door: nothing is done, and not a wn is spent, beyond the policy."""

from __future__ import annotations

import asyncio
import json
import unicodedata
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

import aiohttp
import pytest
import pytest_asyncio
from mcp.shared.exceptions import MCPError
from mcp_types import ElicitResult
from mcp_types.version import LATEST_HANDSHAKE_VERSION, LATEST_MODERN_VERSION

from mesh.signer.protocol import SignerError
from mesh.testing import Market
from tests.support.mcp.hostile import CALLS, HIDDEN_TOOLS, STORIES, URIS, Attempt, Story, table
from tests.support.mcp.world import INJECTION, PRICE, World, content, ended

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Iterator

    from mcp import Client

    from mesh.testing import MarketChain

pytestmark = pytest.mark.asyncio(loop_scope="module")
PAGE = Path(__file__).parents[3] / "docs" / "reference" / "door-attacks.md"


@pytest_asyncio.fixture(scope="module", loop_scope="module")
async def world(market_chain: MarketChain, tmp_path_factory: pytest.TempPathFactory) -> AsyncIterator[World]:
    folder = tmp_path_factory.mktemp("hostile")
    async with Market(market_chain) as market, World(market, folder) as world:
        world.write_policy(hour="60 XRT")
        await world.owner.use_policy()
        yield world


@pytest_asyncio.fixture(scope="module", loop_scope="module")
async def client(world: World) -> AsyncIterator[Client]:
    queue: asyncio.Queue[Any] = asyncio.Queue()
    over = asyncio.Event()

    async def hold() -> None:  # the SDK wants its client to be left by the task that entered it
        async with world.door(LATEST_MODERN_VERSION) as client:
            queue.put_nowait(client)
            await over.wait()

    task = asyncio.create_task(hold())
    yield await queue.get()
    over.set()
    await task


async def state(world: World) -> tuple[int, int]:
    """What the person has, and how many jobs there are."""
    return await world.money(), len((await world.owner_jobs()).jobs)


@pytest.mark.parametrize("attempt", CALLS, ids=[one.tried for one in CALLS])
async def test_a_call_is_refused(world: World, client: Client, attempt: Attempt) -> None:
    before = await state(world)
    arguments = attempt.arguments
    if attempt.tool == "order":
        arguments = world.order(f"key {attempt.tried}"[:100]) | arguments
    result = await client.call_tool(attempt.tool, arguments)
    assert result.is_error
    found = result.structured_content
    assert found is not None
    assert found["code"] == attempt.code, found
    assert found["message"]
    assert found["next"]
    assert len(json.dumps(found)) < 2_000, "what was asked is not repeated at length"
    assert await state(world) == before
    if attempt.tool == "order" and attempt.code != "invalid-request":
        last = (await world.logged())[-1]
        assert (last.event, last.facts["code"]) == ("refused", attempt.code)


@pytest.mark.parametrize("name", HIDDEN_TOOLS)
async def test_what_is_the_owners_is_no_tool(world: World, client: Client, name: str) -> None:
    before = await state(world)
    with pytest.raises(MCPError):
        await client.call_tool(name, {"id": "consent-0123456789abcdef", "allow": True})
    assert await state(world) == before


@pytest.mark.parametrize("uri", URIS)
async def test_a_resource_that_there_is_not(client: Client, uri: str) -> None:
    with pytest.raises(MCPError) as caught:
        await client.read_resource(uri)
    assert "root:" not in str(caught.value)
    assert caught.value.error.data["code"] == "no-such-resource"


async def test_the_same_order_ten_times_at_once_is_one_job(world: World) -> None:
    before, made = await world.money(), await world.contracts()
    async with world.door(LATEST_MODERN_VERSION) as one, world.door(LATEST_HANDSHAKE_VERSION) as other:
        calls = [client.call_tool("order", world.order("ten")) for client in (one, other) for _ in range(5)]
        jobs = [content(result) for result in await asyncio.gather(*calls)]
        assert len({job["job_id"] for job in jobs}) == 1
        assert (await ended(one, jobs[0]))["state"] == "done"
        changed = await other.call_tool("order", world.order("ten", cost="3 XRT"))
        assert changed.structured_content is not None
        assert changed.structured_content["code"] == "idempotency-conflict"
    assert (await world.money(), await world.contracts()) == (before - PRICE, made + 1)


async def test_orders_at_once_over_two_doors_stay_within_the_budget(world: World) -> None:
    left = (await world.signer_balance()).hour_left.units
    before, made = await world.money(), await world.contracts()
    world.write_policy(hour=f"{(60 * 10**9 - left) + 2 * PRICE}wn", jobs=20)
    await world.owner.use_policy()
    try:
        async with world.door(LATEST_MODERN_VERSION) as one, world.door(LATEST_HANDSHAKE_VERSION) as other:
            calls = [
                client.call_tool("order", world.order(f"race {number}"))
                for number, client in enumerate([one, other] * 10)
            ]
            results = await asyncio.gather(*calls)
            taken = [content(one) for one in results if not one.is_error]
            refused = {one.structured_content["code"] for one in results if one.is_error and one.structured_content}
            assert len(taken) == 2
            assert refused == {"hour-budget-spent"}
            assert [(await ended(one, job))["state"] for job in taken] == ["done", "done"]
        assert (await world.money(), await world.contracts()) == (before - 2 * PRICE, made + 2)
    finally:
        world.write_policy(hour="60 XRT")
        await world.owner.use_policy()


async def test_no_more_jobs_at_a_time_than_allowed(world: World, client: Client) -> None:
    calls = [client.call_tool("order", world.order(f"many {number}")) for number in range(4)]
    results = await asyncio.gather(*calls)
    taken = [content(one) for one in results if not one.is_error]
    assert len(taken) == 2
    assert {one.structured_content["code"] for one in results if one.structured_content and one.is_error} == {
        "too-many-jobs"
    }
    for job in taken:
        await ended(client, job)


async def test_a_yes_that_nobody_gave_is_none(world: World, client: Client) -> None:
    """The model makes up the answer of a form that was not asked, and tries the owner's operations."""
    before = await world.money()
    asked = world.order("forged", cost="4 XRT")
    job = content(await client.call_tool("order", asked))
    assert job["state"] == "needs-consent"
    forged: Any = {job["consent"]["id"]: ElicitResult(action="accept", content={"allow": True})}
    again = await client.session.call_tool("order", asked, input_responses=forged, allow_input_required=True)
    assert again.structured_content["state"] == "needs-consent"  # type: ignore[union-attr]
    async with aiohttp.ClientSession(connector=aiohttp.UnixConnector(path=str(world.signer.door))) as session:
        for operation, body in (
            ("approve", {"id": job["consent"]["id"]}),
            ("answer_consent", {"id": job["consent"]["id"], "allow": True}),
            ("use_policy", {}),
        ):
            async with session.post(f"http://signer/v1/{operation}", json=body) as response:
                code = (await response.json())["error"]["code"]
                assert code == ("consent-not-by-client" if operation == "answer_consent" else "unknown-operation")
    await world.owner.deny(job["consent"]["id"])
    for answer in (world.owner.approve, world.owner.deny):
        with pytest.raises(SignerError) as caught:
            await answer(job["consent"]["id"])
        assert caught.value.code == "consent-used"
    assert content(await client.call_tool("job", {"job_id": job["job_id"]}))["state"] == "denied"
    assert await world.money() == before


def strings(found: Any, marked: bool = False) -> Iterator[tuple[str, bool]]:
    """All texts of an answer, and whether they stand in a marked field."""
    if isinstance(found, dict):
        is_marked = found.keys() == {"text", "from"}
        for name, each in found.items():
            yield name, marked
            yield from strings(each, marked or is_marked)
    elif isinstance(found, list):
        for each in found:
            yield from strings(each, marked)
    elif isinstance(found, str):
        yield found, marked


def check_marked(found: Any, *, choices: bool = False) -> int:
    """Every stranger's text is marked, short, and shows what it is; returns how many attacks were in it."""
    attacks = 0
    for text, is_marked in strings(found):
        assert len(text) <= 5_000
        for letter in text:
            assert unicodedata.category(letter) not in ("Cc", "Cf", "Cs", "Co"), repr(text)
        if INJECTION[:20] in text:
            attacks += 1
            assert is_marked or choices, text
    return attacks


async def test_texts_of_strangers_are_marked_wherever_they_stand(world: World, client: Client) -> None:
    tools = await client.list_tools()
    robots = content(await client.call_tool("find_robots", {}))
    assert check_marked(robots) >= 2
    assert check_marked(content(await client.call_tool("describe_model", {"model": world.cid}))) >= 5
    messages = world.order("")["messages"]
    check_marked(content(await client.call_tool("quote", {"model": world.cid, "messages": messages})))
    job = await ended(client, content(await client.call_tool("order", world.order("marked"))))
    check_marked(job)
    asked = {"job_id": job["job_id"]}
    check_marked(content(await client.call_tool("recording", asked)))
    assert check_marked(content(await client.call_tool("recording", asked | {"topic": "/added"}))) >= 1
    check_marked(content(await client.call_tool("verify", asked)))
    check_marked(content(await client.call_tool("statement", {})))
    failing = [{"topic": "/count", "value": {"count": 1, "mode": "fail"}}]
    failed = await ended(client, content(await client.call_tool("order", world.order("fails", messages=failing))))
    assert failed["state"] == "refunded"
    check_marked(failed)
    check_marked(content(await client.call_tool("recording", {"job_id": failed["job_id"], "topic": "/aira/note"})))
    assert await client.list_tools() == tools
    assert INJECTION[:20] not in tools.model_dump_json()


async def test_at_the_end_the_log_holds(world: World) -> None:
    checked = await world.owner.verify_log()
    assert checked.holds, checked.fault


async def test_the_page_has_the_cases() -> None:
    assert table() in PAGE.read_text(encoding="utf-8")
    assert len(CALLS) + len(HIDDEN_TOOLS) + len(URIS) + len(STORIES) >= 60


@pytest.mark.parametrize("story", STORIES, ids=[one.tried for one in STORIES])
async def test_each_story_of_the_page_has_its_test(story: Story) -> None:
    module, _, name = story.test.rpartition(".")
    assert callable(getattr(import_module(f"tests.{module}"), name))
