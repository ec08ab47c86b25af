"""Orders that need a person's yes, over the door: by the owner, and by the client where the policy says so."""

from __future__ import annotations

from typing import Any

import pytest
from mcp_types import ElicitRequestFormParams, ElicitResult
from mcp_types.version import LATEST_HANDSHAKE_VERSION, LATEST_MODERN_VERSION

from tests.support.mcp.world import PRICE, World, content, ended

BOTH = pytest.mark.parametrize("version", [LATEST_MODERN_VERSION, LATEST_HANDSHAKE_VERSION])


class Person:
    """Answers the forms that a client shows."""

    def __init__(self, action: Any = "accept", *, allow: bool = True) -> None:
        self.asked: list[str] = []
        self._answer = ElicitResult(action=action, content={"allow": allow} if action == "accept" else None)

    async def __call__(self, context: Any, params: Any) -> ElicitResult:
        assert isinstance(params, ElicitRequestFormParams)
        self.asked.append(params.message)
        return self._answer


async def test_the_owner_allows_one_order_and_only_that(world: World) -> None:
    world.write_policy(above="1 XRT")
    await world.owner.use_policy()
    before = await world.money()
    async with world.door(LATEST_MODERN_VERSION) as client:
        first = content(await client.call_tool("order", world.order("one")))
        second = content(await client.call_tool("order", world.order("two")))
        assert (first["state"], second["state"]) == ("needs-consent", "needs-consent")
        assert first["consent"]["command"] == f"aira mcp approve {first['consent']['id']}"
        assert {one.job_id for one in await world.owner.consents()} == {first["job_id"], second["job_id"]}
        await world.owner.approve(first["consent"]["id"])
        assert (await ended(client, first))["state"] == "done"
        await world.owner.deny(second["consent"]["id"])
        assert (await ended(client, second))["state"] == "denied"
    assert await world.money() == before - PRICE


@BOTH
async def test_a_yes_of_the_client_counts_where_the_policy_says_so(world: World, version: str) -> None:
    world.write_policy(above="1 XRT", by_client=True)
    await world.owner.use_policy()
    person, before, made = Person(), await world.money(), await world.contracts()
    async with world.door(version, elicitation_callback=person) as client:
        job = content(await client.call_tool("order", world.order("one")))
        assert job["state"] != "needs-consent"
        assert (await ended(client, job))["state"] == "done"
    [question] = person.asked
    assert "2 XRT" in question
    assert world.robot in question
    assert question.isascii()
    assert (await world.money(), await world.contracts()) == (before - PRICE, made + 1)


@BOTH
async def test_otherwise_the_client_is_not_even_asked(world: World, version: str) -> None:
    world.write_policy(above="1 XRT")
    await world.owner.use_policy()
    person, before = Person(), await world.money()
    async with world.door(version, elicitation_callback=person) as client:
        job = content(await client.call_tool("order", world.order("one")))
        assert job["state"] == "needs-consent"
    assert person.asked == []
    assert await world.money() == before


@BOTH
@pytest.mark.parametrize("person", [Person(allow=False), Person("decline")], ids=["no", "decline"])
async def test_a_no_of_the_client_denies_the_order(world: World, version: str, person: Person) -> None:
    world.write_policy(above="1 XRT", by_client=True)
    await world.owner.use_policy()
    async with world.door(version, elicitation_callback=person) as client:
        assert content(await client.call_tool("order", world.order("one")))["state"] == "denied"


async def test_a_client_that_can_not_ask_leaves_the_order_to_the_owner(world: World) -> None:
    world.write_policy(above="1 XRT", by_client=True)
    await world.owner.use_policy()
    async with world.door(LATEST_MODERN_VERSION) as client:
        job = content(await client.call_tool("order", world.order("one")))
        assert job["state"] == "needs-consent"
        await world.owner.approve(job["consent"]["id"])
        assert (await ended(client, job))["state"] == "done"
