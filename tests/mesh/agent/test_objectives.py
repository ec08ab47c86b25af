"""Objectives: from the store or fetched from others, and checked before they are played."""

from __future__ import annotations

from contextlib import asynccontextmanager
from typing import TYPE_CHECKING, Any

import pytest

from mesh.agent.handlers import TopicHandlers
from mesh.agent.objectives import Objectives, ObjectiveUnfit
from mesh.content import ContentUnavailable
from mesh.errors import InputError
from schemas import Empty, cid_of_bytes
from tests.support.objectives import objective

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    from mesh.agent.components import AgentComponents
    from mesh.agent.handlers import Job
    from tests.support.market import Place


@pytest.fixture
async def parts(place: Place) -> AsyncIterator[AgentComponents]:
    """The components of a robot that does nothing by itself."""
    async with opened(place) as parts:
        yield parts


@asynccontextmanager
async def opened(place: Place, **settings: Any) -> AsyncIterator[AgentComponents]:
    async with place.agent("robot", enable_executor=False, **settings) as robot:
        yield robot.parts


def objectives(parts: AgentComponents, handlers: TopicHandlers | None = None) -> Objectives:
    return Objectives(parts.store, parts.exchange, parts.settings, handlers)


def handling(topic: str) -> TopicHandlers:
    """Handlers for one topic."""

    async def handler(job: Job, message: Any) -> None:
        pass

    handlers = TopicHandlers()
    handlers.add(topic, handler)
    return handlers


async def test_an_objective_in_the_store_is_examined_where_it_is(parts: AgentComponents) -> None:
    cid = parts.store.put_bytes(objective(("/a", Empty())))
    found = await objectives(parts).examine(cid)
    assert found.path == parts.store.path(cid)
    assert found.count == 1


async def test_an_objective_of_another_agent_is_fetched(place: Place, parts: AgentComponents) -> None:
    async with place.agent("person") as person:
        cid = person.parts.store.put_bytes(objective(("/a", Empty())))
        assert (await objectives(parts).examine(cid)).count == 1
    assert parts.store.has(cid)


async def test_an_objective_without_a_holder_is_unavailable(place: Place) -> None:
    async with opened(place, fetch_timeout=0.1) as parts:
        with pytest.raises(ContentUnavailable):
            await objectives(parts).examine(cid_of_bytes(b"nobody's"))


async def test_an_objective_damaged_in_the_store_is_fetched_again(place: Place, parts: AgentComponents) -> None:
    content = objective(("/a", Empty()))
    cid = parts.store.put_bytes(content)
    held = parts.store.path(cid)
    assert held is not None
    held.chmod(0o600)
    held.write_bytes(content.replace(b"/a", b"/b"))
    async with place.agent("person") as person:
        person.parts.store.put_bytes(content)
        found = await objectives(parts).examine(cid)
    assert [topic.name for topic in found.topics] == ["/a"]


async def test_an_unfit_objective_names_itself_and_the_reason(parts: AgentComponents) -> None:
    cid = parts.store.put_bytes(objective(("/a", Empty())))
    with pytest.raises(ObjectiveUnfit) as caught:
        await objectives(parts, handling("/b")).examine(cid)
    assert (caught.value.cid, caught.value.reason, caught.value.code) == (cid, "unknown-topic", "objective-unfit")
    assert isinstance(caught.value, InputError)
