"""An agent's own model: derived from its handlers, checked when it starts, and against objectives."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Annotated, Any

import msgspec
import pytest

from mesh import Agent, ConfigurationError, ModelDescription, ModelLimits, ModelUnfit, ObjectiveUnfit, Settings
from mesh.testing import assert_paid
from schemas import Empty, String, cid_of_file
from schemas.model import InvalidDescription, ModelTopic, ValueSchema
from tests.support.market import offering
from tests.support.objectives import objective
from tests.support.raising import raises_with

if TYPE_CHECKING:
    from pathlib import Path

    from mesh.agent.handlers import Job
    from mesh.testing import Market


class Move(msgspec.Struct):
    """Moves the robot."""

    speed: Annotated[float, msgspec.Meta(ge=0, le=2, title="Speed", extra_json_schema={"unit": "m/s"})]
    turn: float = 0.0


def driving(agent: Agent) -> Agent:
    """The same agent, which drives."""

    @agent.on("/drive")
    async def drive(job: Job, move: Move) -> None:
        job.publish("/position", move.speed)

    @agent.on("/stop")
    async def stop(job: Job, nothing: Empty) -> None: ...

    return agent


def driver() -> Agent:
    return driving(Agent(settings=Settings()))


DRIVE = driver().model_description(
    "Drive", result={"/position": float}, price="5 XRT", seconds=2, limits=ModelLimits(messages=3)
)


def saved(path: Path, content: bytes) -> Path:
    path.write_bytes(content)
    return path


@pytest.fixture
def file(tmp_path: Path) -> Path:
    return saved(tmp_path / "model.json", DRIVE.encode())


def test_handlers_say_what_a_model_is() -> None:
    speed = ValueSchema(type="number", title="Speed", unit="m/s", minimum=0, maximum=2)
    move = ValueSchema(
        type="object",
        description="Moves the robot.",
        properties={"speed": speed, "turn": ValueSchema(type="number", default=0)},
        required=("speed",),
    )
    assert (
        ModelDescription(
            title="Drive",
            objective=(
                ModelTopic(topic="/drive", value=move),
                ModelTopic(topic="/stop", encoding="ros1;std_msgs/Empty", value=ValueSchema(type="null")),
            ),
            result=(ModelTopic(topic="/position", value=ValueSchema(type="number")),),
            price="5 XRT",
            seconds=2,
            limits=ModelLimits(messages=3),
        )
        == DRIVE
    )


def test_a_handler_for_all_topics_is_described() -> None:
    agent = driver()

    @agent.on("*")
    async def anything(job: Job, message: object) -> None: ...

    description = agent.model_description("Anything")
    assert description.other_topics
    assert [topic.topic for topic in description.objective] == ["/drive", "/stop"]


def test_a_description_out_of_range_is_refused() -> None:
    with pytest.raises(InvalidDescription):
        driver().model_description("")
    with pytest.raises(InvalidDescription):
        driver().model_description("Drive", seconds=-1)


def changed(**fields: Any) -> ModelDescription:
    return msgspec.structs.replace(DRIVE, **fields)


@pytest.mark.parametrize(
    ("description", "fits"),
    [
        (DRIVE, True),
        (changed(title="Drives", success="It stands."), True),
        (changed(objective=DRIVE.objective[:1]), False),
        (changed(objective=(*DRIVE.objective, ModelTopic(topic="/fly"))), False),
        (changed(other_topics=True), False),
        (changed(objective=(ModelTopic(topic="/drive"), DRIVE.objective[1])), False),
    ],
)
async def test_an_agent_starts_only_if_its_handlers_fit_its_model(
    market: Market, file: Path, description: ModelDescription, fits: bool
) -> None:
    robot = driving(Agent(saved(file, description.encode())))
    if fits:
        async with market.robot(robot):
            assert robot.model == description.cid == cid_of_file(file)
            assert robot.parts.store.has(robot.model)
    else:
        with raises_with(ModelUnfit, model=description.cid):
            async with market.robot(robot):
                pass


async def test_an_agent_without_handlers_fits_any_model(market: Market, file: Path) -> None:
    async with market.robot(Agent(file)) as robot:
        assert robot.model == DRIVE.cid


async def test_a_text_is_a_model_too(market: Market, tmp_path: Path) -> None:
    text = saved(tmp_path / "model.md", b"# A robot that drives\n")
    async with market.robot(driving(Agent(text))) as robot:
        assert robot.model == cid_of_file(text)
        assert robot.parts.store.has(robot.model)


async def test_a_description_that_is_not_valid_ends_the_start(market: Market, file: Path) -> None:
    with pytest.raises(InvalidDescription):
        async with market.robot(Agent(saved(file, DRIVE.encode().rstrip()))):
            pass


async def test_a_file_that_is_missing_ends_the_start(market: Market, tmp_path: Path) -> None:
    missing = tmp_path / "model.json"
    with raises_with(ConfigurationError, code="model-unreadable", match=re.escape(str(missing))):
        async with market.robot(Agent(missing)):
            pass


async def test_a_robot_finds_the_description_of_its_model_in_its_store(market: Market) -> None:
    async with market.robot(Agent(DRIVE.cid)) as robot:
        robot.parts.store.put_bytes(DRIVE.encode(), pin="test")

    @robot.on("/fly")
    async def fly(job: Job, message: object) -> None: ...

    with pytest.raises(ModelUnfit):
        async with market.robot(robot):
            pass


FAST = [("/drive", {"speed": 3.0})]
GOOD = [("/drive", {"speed": 1.0}), ("/stop", Empty())]


async def test_a_robot_examines_objectives_by_its_models_description(market: Market, file: Path) -> None:
    async with market.robot(Agent(file)) as robot:  # without handlers: only the description speaks
        store = robot.parts.store
        assert (await robot.examine(store.put_bytes(objective(*GOOD)))).count == 2
        for messages, reason in (
            (FAST, "unfit-message"),
            ([("/stop", String(""))], "unfit-message"),
            ([("/fly", Empty())], "unknown-topic"),
            ([("/stop", Empty())] * 4, "too-many-messages"),
        ):
            with raises_with(ObjectiveUnfit, reason=reason):
                await robot.examine(store.put_bytes(objective(*messages)))


async def test_a_person_orders_nothing_that_the_model_excludes(market: Market, file: Path) -> None:
    person = await market.person()
    person.parts.store.put_bytes(DRIVE.encode())  # found without waiting for the robot's store
    async with market.robot(offering(driving(Agent(file)))):
        with raises_with(ObjectiveUnfit, reason="unfit-message"):
            await market.demand(DRIVE.cid, FAST, by=person)
        assert person.orders() == []
        assert_paid(await market.order(DRIVE.cid, GOOD, by=person))


async def test_a_person_orders_nothing_of_a_model_that_is_not_valid(market: Market) -> None:
    person = await market.person()
    model = person.parts.store.put_bytes(DRIVE.encode().rstrip())
    with pytest.raises(InvalidDescription):
        await person.order(GOOD, model=model)
    assert person.orders() == []


async def test_a_person_orders_an_objective_that_is_not_available_to_it(market: Market) -> None:
    person = await market.person()
    person.parts.store.put_bytes(DRIVE.encode())
    order = await person.order(changed(title="Nobody has this").cid, model=DRIVE.cid)
    assert person.orders() == [order]
