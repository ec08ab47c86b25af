"""`aira robots`, and the names of robots in other commands."""

from __future__ import annotations

import asyncio
import json
import re
import shlex
from contextlib import asynccontextmanager
from typing import TYPE_CHECKING

import pytest

from mesh.cli import status as commands
from mesh.cli.files import objective_of
from mesh.cli.options import MessageText
from mesh.cli.robots import command, doing, message_like, record_of
from mesh.cli.watch import watch
from mesh.errors import InputError
from mesh.network import Endpoints, Network
from mesh.recording import open_objective
from mesh.watching.robots import Robot
from schemas import ProfileKey
from schemas.address import shortened
from schemas.model import ModelDescription, ModelTopic, ValueSchema
from tests.mesh.agent.test_own_model import DRIVE, driving
from tests.support.commands import coroutine
from tests.support.market import MODEL, offering
from tests.support.objectives import objective
from tests.support.orders import ROBOT
from tests.support.ports import free_port
from tests.support.raising import raises_with
from tests.support.waiting import until, until_answered

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    from mesh.agent.agent import Agent
    from mesh.settings import Settings
    from tests.support.market import Place


@asynccontextmanager
async def lift(place: Place) -> AsyncIterator[tuple[Agent, Settings]]:
    """A robot with a name that is present, and the settings of a reader without a node."""
    model = place.save(DRIVE.encode(), "model.json")
    async with (
        offering(driving(place.agent("robot", model, name="Lift 1", place="Hall 3"))) as robot,
        Network(Endpoints(connect=(place.endpoint,))) as network,
    ):
        await until_answered(network.session, str(ProfileKey(robot.address)))
        yield robot, place.settings("watcher", web3_http_provider=f"http://127.0.0.1:{free_port()}")


async def test_robots_are_listed_also_without_a_node(place: Place, capsys: pytest.CaptureFixture[str]) -> None:
    async with lift(place) as (robot, settings):
        await coroutine(command)(settings, None, None, timeout=60.0, as_json=False)
        shown = capsys.readouterr()
        head, row = shown.out.splitlines()
        assert cells(head) == ["name", "address", "does", "now", "price", "record", "place", "reads"]
        assert cells(row) == ["Lift 1", robot.address, DRIVE.title, "idle", "5 XRT", "unknown", "Hall 3"]
        assert shown.err.startswith("aira: no records: ")
        await coroutine(command)(settings, None, DRIVE.cid, timeout=60.0, as_json=True)
        (found,) = json.loads(capsys.readouterr().out)["robots"]
        assert (found["name"], found["address"], found["model"]) == ("Lift 1", robot.address, DRIVE.cid)
        assert (found["state"], found["queue"], found["wait"]) == ("idle", 0, 0)
        assert (found["paid"], found["refunded"]) == (None, None)
        await coroutine(command)(settings, None, MODEL, timeout=60.0, as_json=False)
        assert capsys.readouterr().out == f"no robots of this model on {place.market.deployment.lighthouse_name}\n"


async def test_a_robot_is_shown_with_the_command_that_orders_it(
    place: Place, capsys: pytest.CaptureFixture[str]
) -> None:
    async with lift(place) as (robot, settings):
        await coroutine(command)(settings, "LIFT 1", None, timeout=60.0, as_json=False)
        shown = capsys.readouterr().out
        assert cells(shown.splitlines()[1]) == ["address", robot.address]
        assert DRIVE.title in shown.splitlines()
        (order,) = re.findall("^to order it:  aira (.+)$", shown, re.MULTILINE)
        named = shlex.split(order)
        assert named[:-1] == ["demand", "--robot", robot.address, "--cost", "5 XRT", "--message"]
        topic, value = MessageText().convert(named[-1], None, None)
        described = DRIVE.topic(topic)
        assert described is not None
        assert described.value is not None
        assert described.value.fault(value) == ""
        with raises_with(InputError, code="robot-unknown"):
            await coroutine(command)(settings, "Lift 2", None, timeout=60.0, as_json=False)
        with raises_with(InputError, code="robot-unknown"):
            await coroutine(command)(settings, place.address("person"), None, timeout=60.0, as_json=False)


@pytest.mark.parametrize(
    "schema",
    [
        ValueSchema(),
        ValueSchema(type="boolean"),
        ValueSchema(type="integer", minimum=1, maximum=100),
        ValueSchema(type="integer", maximum=-3),
        ValueSchema(type="number", exclusive_minimum=0, maximum=0.5),
        ValueSchema(type="number", exclusive_minimum=2),
        ValueSchema(type="number", exclusive_maximum=-1),
        ValueSchema(type="number", minimum=1, default=5),
        ValueSchema(type="string", min_length=3),
        ValueSchema(type="string", enum=("left", "right")),
        ValueSchema(type="array", items=ValueSchema(type="integer", minimum=2), min_items=2),
        ValueSchema(
            type="object",
            properties={"x": ValueSchema(type="number"), "note": ValueSchema(type="string")},
            required=("x",),
        ),
    ],
)
def test_the_message_that_is_shown_is_one_that_the_robot_takes(schema: ValueSchema) -> None:
    topic, value = MessageText().convert(message_like(ModelTopic(topic="/go", value=schema)), None, None)
    assert (topic, schema.fault(value)) == ("/go", "")


async def test_messages_get_the_types_that_the_model_says(place: Place) -> None:
    volume = ModelTopic(topic="/volume", encoding="application/json;Volume", value=ValueSchema(type="integer"))
    model = place.save(ModelDescription(title="Speaker", objective=(volume,)).encode(), "model.json")
    async with place.agent("person", model) as person:
        cid = await objective_of(person, [MessageText().convert("/volume 5", None, None)])
        (message,) = open_objective(await person.fetch(cid)).messages()
        assert (message.topic, message.payload, message.type.schema_name) == ("/volume", b"5", "Volume")


def cells(line: str) -> list[str]:
    return re.split("  +", line)


def robot(**fields: object) -> Robot:
    texts = dict.fromkeys(("model", "name", "about", "picture", "place", "price"), "")
    facts = {"address": ROBOT.address, "state": "idle", "queue": 0, "wait": 0, "readings": {}, "time": 0} | texts
    return Robot(**facts | fields)  # type: ignore[arg-type]


def test_what_a_robot_is_doing_is_said_in_words() -> None:
    assert doing(robot()) == "idle"
    assert doing(robot(state="working", queue=1, wait=90)) == "working, 1 job waits, about 90 s"
    assert doing(robot(state="stopped", queue=2)) == "stopped, 2 jobs wait"
    assert record_of(robot(paid=1_200, refunded=0)) == "1,200 paid, 0 refunded"
    earlier = ("0x" + "1" * 40, "0x" + "2" * 40)
    moved = robot(paid=3, refunded=1, formerly=earlier)
    assert record_of(moved) == "3 paid, 1 refunded, formerly 0x1111…1111, 0x2222…2222"


async def test_status_shows_the_names_of_robots(place: Place, capsys: pytest.CaptureFixture[str]) -> None:
    async with lift(place) as (robot, settings), place.agent("person"):
        await coroutine(commands.status)(settings, None, timeout=60.0, as_json=False)
        head, *rows = capsys.readouterr().out.splitlines()
        assert cells(head) == ["role", "address", "name", "status"]
        assert ["agent", robot.address, "Lift 1"] in [cells(row)[:3] for row in rows]
        await coroutine(commands.status)(settings, None, timeout=60.0, as_json=True)
        peers = {peer["address"]: peer for peer in json.loads(capsys.readouterr().out)["peers"]}
        assert peers[robot.address]["name"] == "Lift 1"
        assert "name" not in peers[place.address("person")]
        await coroutine(commands.status)(settings, robot.address, timeout=60.0, as_json=False)
        assert cells(capsys.readouterr().out.splitlines()[0]) == ["name", "Lift 1"]


async def test_watch_shows_the_name_of_a_robot_with_its_short_address(
    place: Place, capsys: pytest.CaptureFixture[str]
) -> None:
    out = ""

    def shown() -> str:
        nonlocal out
        out += capsys.readouterr().out
        return out

    async with lift(place) as (robot, settings), place.provider(), place.agent("person") as person:
        watching = asyncio.create_task(watch(settings, None, with_open=True, as_json=False))
        work = place.save(objective(("/drive", {"speed": 1.0})))
        contract = await person.demand(work, model=DRIVE.cid, cost=1)
        await contract.outcome()
        who = f"Lift 1 ({shortened(robot.address)})"
        await until(lambda: f"  {who} works for " in shown(), what="the offer")
        await until(lambda: f"{contract.address}  {who} for " in shown(), what="the job")
        await until(lambda: f"signed by {who}" in shown(), what="the result")
        watching.cancel()
        await asyncio.wait([watching])
