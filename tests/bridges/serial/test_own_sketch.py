"""A hobbyist's own sketch, with an input and a PWM output, works for money; docs/guides/devices.md shows how."""

from __future__ import annotations

import asyncio
import re
import runpy
from typing import TYPE_CHECKING, Any

from bridges.serial._device import Device
from bridges.serial.firmware import compile_sketch, size_of
from mesh.recording import open_objective
from schemas.payloads import decode_value
from tests.support.boards import DIMMER, LIBRARIES, ROOT, board, edge, firmware
from tests.support.market import offering
from tests.support.objectives import objective

if TYPE_CHECKING:
    from pathlib import Path

    from mesh.agent.handlers import Job
    from tests.support.market import Place


LONG = 60.0
BUTTON = 2


async def test_a_lamp_is_dimmed_for_money_and_a_button_ends_the_job(place: Place) -> None:
    """The sketch knows pins and numbers from 0 to 255; the robot's code makes percents and a wish of it."""
    robot = offering(place.agent("robot"))
    device = Device(robot, patience=LONG)
    cost, waiting = 5, asyncio.Event()

    @robot.on("/brightness")
    async def brightness(job: Job, percent: float) -> None:
        await device.call("/dim", round(percent / 100 * 255), job=job)

    @robot.on("/until_pressed")
    async def until_pressed(job: Job, message: object) -> None:
        presses = job.listen("/button")
        waiting.set()
        async for pressed in presses:
            if pressed:
                return

    source = place.save(objective(("/brightness", 25.0), ("/brightness", 50.0), ("/until_pressed", True)))
    before = await place.balance("robot")
    with board(DIMMER) as uno, edge(uno.port, place.address("robot"), place.endpoint):
        async with place.at_work(robot) as person:
            contract = await person.demand(source, cost=cost)
            async with asyncio.timeout(LONG):
                await waiting.wait()
            uno.set_pin(BUTTON, False)
            assert (await contract.outcome()).success
            recording = await contract.recording()
            assert await place.balance("robot") == before + cost
    assert [(dimming.pin, dimming.value) for dimming in uno.dimmings] == [(9, 64), (9, 128)]
    values: dict[str, list[Any]] = {}
    for message in open_objective(recording).messages():
        values.setdefault(message.topic, []).append(decode_value(message.payload, message.type))
    assert values["/dim"][:2] == [64, 128]
    assert values["/button"] == [True]


def test_the_sketch_and_the_robot_of_the_page_about_devices_are_complete(tmp_path: Path) -> None:
    firmware(DIMMER)  # skips the test where the tools are missing
    text = (ROOT / "docs" / "guides" / "devices.md").read_text()
    [sketch], [robot] = (re.findall(f"```{kind}\n(.*?)```", text, re.DOTALL) for kind in ("cpp", "python"))
    for name, source in (("lamp/lamp.ino", sketch), ("robot.py", robot), ("model.md", "Dims a lamp")):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(source)
    flash, _ = size_of(compile_sketch(tmp_path / "lamp", tmp_path / "lamp.elf", libraries=[LIBRARIES]))
    assert flash > 0
    assert {"agent", "board", "brightness"} <= runpy.run_path(str(tmp_path / "robot.py")).keys()
