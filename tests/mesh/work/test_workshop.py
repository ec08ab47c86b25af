"""From a liability to an objective in hand, and to a run that goes on with what a crash has left."""

from __future__ import annotations

from contextlib import asynccontextmanager
from typing import TYPE_CHECKING, Any

import pytest

from mesh.agent.hooks import HandlerTopics, Hooks
from mesh.content import ContentUnavailable
from mesh.errors import InputError
from mesh.recording import AtOnce, RecordedTimes, open_objective
from mesh.work.workshop import UnfitObjective, Workshop
from schemas import Empty, String, cid_of_bytes
from tests.mesh.work.samples import liability
from tests.support.objectives import objective

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    from mesh.recording import Objective
    from mesh.work.job import Job, TopicHandler
    from tests.support.market import Place


@pytest.fixture
async def shop(place: Place) -> AsyncIterator[Workshop]:
    """The workshop of a robot that does nothing by itself."""
    async with opened(place) as shop:
        yield shop


@asynccontextmanager
async def opened(place: Place, **settings: Any) -> AsyncIterator[Workshop]:
    async with place.agent("robot", enable_executor=False, **settings) as robot:
        yield robot.parts.workshop()


async def examined(shop: Workshop, cid: str, performer: TopicHandler | None = None) -> Objective:
    """The objective of that CID, fetched where it has to be."""
    return await shop.examine(cid, await shop.fetch(cid), performer=performer)


def taking(topic: str) -> TopicHandler:
    """A performer that has a handler for one topic."""

    async def handler(job: Job, message: Any) -> None:
        pass

    return HandlerTopics(Hooks(topics={topic: (handler, None)}))


async def test_an_objective_in_the_store_is_examined_where_it_is(shop: Workshop) -> None:
    cid = shop.store.put_bytes(objective(("/a", Empty())))
    found = await examined(shop, cid)
    assert found.path == shop.store.path(cid)
    assert found.count == 1


async def test_an_objective_of_somebody_else_is_fetched(place: Place, shop: Workshop) -> None:
    async with place.agent("person") as person:
        cid = person.parts.store.put_bytes(objective(("/a", Empty())))
        assert (await examined(shop, cid)).count == 1
    assert shop.store.has(cid)


async def test_an_objective_that_nobody_has_is_not_to_be_had(place: Place) -> None:
    async with opened(place, fetch_timeout=0.1) as shop:
        with pytest.raises(ContentUnavailable):
            await examined(shop, cid_of_bytes(b"nobody's"))


async def test_an_objective_rotten_in_the_store_is_fetched_anew(place: Place, shop: Workshop) -> None:
    content = objective(("/a", Empty()))
    cid = shop.store.put_bytes(content)
    held = shop.store.path(cid)
    assert held is not None
    held.chmod(0o600)
    held.write_bytes(content.replace(b"/a", b"/b"))
    async with place.agent("person") as person:
        person.parts.store.put_bytes(content)
        found = await examined(shop, cid)
    assert [topic.name for topic in found.topics] == ["/a"]


async def test_an_unfit_objective_says_which_and_why(shop: Workshop) -> None:
    cid = shop.store.put_bytes(objective(("/a", Empty())))
    with pytest.raises(UnfitObjective, match=f"objective {cid} can't be played") as caught:
        await examined(shop, cid, taking("/b"))
    assert caught.value.reason == "unknown-topic"
    assert isinstance(caught.value, InputError)


async def test_a_run_that_was_cut_off_is_gone_on_with(shop: Workshop) -> None:
    first = await shop.new_run(liability())
    first.open()
    first.publish("/led", "before")
    await first.close()  # and then, before the Result was written down, a crash
    second = await shop.new_run(liability())
    second.open()
    second.publish("/led", "after")
    summary = await second.close()
    assert summary.recovered == 1
    said = [String.decode(message.payload).data for message in open_objective(summary.path).messages()]
    assert said == ["before", "after"]


@pytest.mark.parametrize("leftover", ["", ".part", ".cut"])
async def test_a_discarded_recording_leaves_nothing_to_go_on_with(shop: Workshop, leftover: str) -> None:
    first = await shop.new_run(liability())
    first.open()
    first.publish("/led", "before")
    path = (await first.close()).path
    path.rename(path.with_name(path.name + leftover))
    shop.discard_recording(liability().address)
    summary = await (await shop.new_run(liability())).close()
    assert (summary.messages, summary.recovered) == (0, 0)


async def test_a_discarded_recording_need_not_be_there(shop: Workshop) -> None:
    shop.discard_recording(liability().address)


async def test_the_settings_choose_pace_and_topics(place: Place) -> None:
    async with opened(place, playback="recorded", recording_topics=" /a,/b/c ,") as shop:
        run = await shop.new_run(liability())
        assert run._plan.pace == RecordedTimes()
        assert run._plan.topics == frozenset({"/a", "/b/c"})
        await run.close()
    async with opened(place) as shop:
        run = await shop.new_run(liability())
        assert run._plan.pace == AtOnce()
        assert run._plan.topics is None
        await run.close()
