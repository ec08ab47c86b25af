"""An agent's own model: derived from its handlers, checked when it starts, and against objectives."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Annotated, Any

import msgspec
import pytest

from mesh import Agent, ConfigurationError, ModelDescription, ModelLimits, ModelUnfit, ObjectiveUnfit, Settings
from schemas import Empty, String, cid_of_file
from schemas.model import InvalidDescription, ModelTopic, ValueSchema
from tests.support.market import offering
from tests.support.objectives import objective
from tests.support.raising import raises_with

if TYPE_CHECKING:
    from pathlib import Path

    from mesh.agent.handlers import Job
    from tests.support.market import Place


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


@pytest.fixture
def file(tmp_path: Path) -> Path:
    path = tmp_path / "model.json"
    path.write_bytes(DRIVE.encode())
    return path


def robot_with(place: Place, model: Path) -> Agent:
    """A robot whose model is a file."""
    settings, account = place.settings("robot"), place.market.accounts["robot"]
    return Agent(model, settings=settings, account=account, chain=place.chains["robot"])


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
    place: Place, tmp_path: Path, description: ModelDescription, fits: bool
) -> None:
    path = tmp_path / "model.json"
    path.write_bytes(description.encode())
    robot = driving(robot_with(place, path))
    if fits:
        async with robot:
            assert robot.model == description.cid == cid_of_file(path)
            assert robot.parts.store.has(robot.model)
    else:
        with pytest.raises(ModelUnfit) as caught:
            await robot.__aenter__()
        assert caught.value.model == description.cid


async def test_an_agent_without_handlers_fits_any_model(place: Place, file: Path) -> None:
    async with robot_with(place, file) as robot:
        assert robot.model == DRIVE.cid


async def test_a_text_is_a_model_too(place: Place, tmp_path: Path) -> None:
    text = tmp_path / "model.md"
    text.write_text("# A robot that drives\n")
    async with driving(robot_with(place, text)) as robot:
        assert robot.model == cid_of_file(text)
        assert robot.parts.store.has(robot.model)


async def test_a_description_that_is_not_valid_ends_the_start(place: Place) -> None:
    with pytest.raises(InvalidDescription):
        await robot_with(place, place.save(DRIVE.encode().rstrip())).__aenter__()


async def test_a_file_that_is_missing_ends_the_start(place: Place) -> None:
    missing = place.folder / "model.json"
    with raises_with(ConfigurationError, code="model-unreadable", match=re.escape(str(missing))):
        await robot_with(place, missing).__aenter__()


async def test_a_robot_finds_the_description_of_its_model_in_its_store(place: Place) -> None:
    async with place.agent("robot", DRIVE.cid) as robot:
        robot.parts.store.put_bytes(DRIVE.encode(), pin="test")
    unfit = place.agent("robot", DRIVE.cid)

    @unfit.on("/fly")
    async def fly(job: Job, message: object) -> None: ...

    with pytest.raises(ModelUnfit):
        await unfit.__aenter__()


FAST = objective(("/drive", {"speed": 3.0}))
GOOD = objective(("/drive", {"speed": 1.0}), ("/stop", Empty()))


async def test_a_robot_examines_objectives_by_its_models_description(place: Place, file: Path) -> None:
    robot = robot_with(place, file)  # without handlers: only the description speaks
    async with robot:
        store = robot.parts.store
        assert (await robot.examine(store.put_bytes(GOOD))).count == 2
        for content, reason in (
            (FAST, "unfit-message"),
            (objective(("/stop", String(""))), "unfit-message"),
            (objective(("/fly", Empty())), "unknown-topic"),
            (objective(*[("/stop", Empty())] * 4), "too-many-messages"),
        ):
            with pytest.raises(ObjectiveUnfit) as caught:
                await robot.examine(store.put_bytes(content))
            assert caught.value.reason == reason


async def test_a_person_orders_nothing_that_the_model_excludes(place: Place, file: Path) -> None:
    async with place.at_work(offering(driving(robot_with(place, file)))) as person:
        person.parts.store.put_bytes(DRIVE.encode())  # found without waiting for the robot's store
        with pytest.raises(ObjectiveUnfit) as caught:
            await person.demand(place.save(FAST, "fast.mcap"), model=DRIVE.cid)
        assert caught.value.reason == "unfit-message"
        assert person.orders() == []
        contract = await person.demand(place.save(GOOD), model=DRIVE.cid)
        assert (await contract.outcome()).success


async def test_a_person_orders_nothing_of_a_model_that_is_not_valid(place: Place) -> None:
    async with place.agent("person") as person:
        model = person.parts.store.put_bytes(DRIVE.encode().rstrip())
        with pytest.raises(InvalidDescription):
            await person.order(place.save(GOOD), model=model)
        assert person.orders() == []


async def test_a_person_orders_an_objective_that_is_not_available_to_it(place: Place) -> None:
    async with place.agent("person") as person:
        person.parts.store.put_bytes(DRIVE.encode())
        order = await person.order(changed(title="Nobody has this").cid, model=DRIVE.cid)
        assert person.orders() == [order]
