"""Descriptions of models: from the store, or from others."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from mesh.role.models import ABSENT, Models
from schemas import cid_of_bytes
from schemas.model import DESCRIPTION_LIMITS, InvalidDescription, ModelDescription
from tests.support.clocks import SECOND, SetClock
from tests.support.waiting import until_found

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    from mesh.agent.components import AgentComponents
    from tests.support.market import Place


LAMP = ModelDescription(title="Lamp")


@pytest.fixture
async def parts(place: Place) -> AsyncIterator[AgentComponents]:
    """The components of a person that does nothing by itself."""
    async with place.agent("person", enable_executor=False) as person:
        yield person.parts


@pytest.fixture
def models(parts: AgentComponents) -> Models:
    return Models(parts.store, parts.exchange)


async def test_a_description_in_the_store_is_found(parts: AgentComponents, models: Models) -> None:
    assert await models.find(parts.store.put_bytes(LAMP.encode())) == LAMP


async def test_a_description_of_another_agent_is_fetched(place: Place, parts: AgentComponents, models: Models) -> None:
    async with place.agent("robot") as robot:
        cid = robot.parts.store.put_bytes(LAMP.encode())

        async def served() -> bool:
            return await parts.exchange.is_held(cid, timeout=5)

        await until_found(served, what="the robot's store")
        assert await models.find(cid) == LAMP
    assert await models.find(cid) == LAMP


@pytest.mark.parametrize(
    "content", [b"# A lamp\n", LAMP.encode() + b" " * DESCRIPTION_LIMITS.size, b'{"title": "Lamp"}']
)
async def test_another_file_is_a_model_without_a_description(
    parts: AgentComponents, models: Models, content: bytes
) -> None:
    cid = parts.store.put_bytes(content)
    if len(content) > DESCRIPTION_LIMITS.size:  # it says that it is one
        with pytest.raises(InvalidDescription) as caught:
            await models.find(cid)
        assert caught.value.reason == "too-large"
    else:
        assert await models.find(cid) is None


async def test_a_model_that_nobody_has_is_looked_for_again_after_a_while(parts: AgentComponents) -> None:
    clock = SetClock()
    models = Models(parts.store, parts.exchange, clock=clock)
    assert await models.find(LAMP.cid) is None
    parts.store.put_bytes(LAMP.encode())
    assert await models.find(LAMP.cid) is None
    clock.pass_by(round(ABSENT.delay(1) + 1) * SECOND)
    assert await models.find(LAMP.cid) == LAMP


async def test_a_file_that_says_it_is_a_description_must_be_valid(parts: AgentComponents, models: Models) -> None:
    cid = parts.store.put_bytes(LAMP.encode().rstrip())
    with pytest.raises(InvalidDescription) as caught:
        await models.find(cid)
    assert caught.value.reason == "not-canonical"


async def test_a_model_nobody_has_is_no_error(models: Models) -> None:
    assert await models.find(cid_of_bytes(b"nobody's model")) is None
