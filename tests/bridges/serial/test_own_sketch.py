"""A hobbyist's own sketch, with an input and a PWM output, works for money; docs/guides/devices.md shows how."""

from __future__ import annotations

import asyncio
import re
import runpy
from typing import TYPE_CHECKING

from bridges.serial._device import Device
from bridges.serial.firmware import compile_sketch, size_of
from mesh import Agent
from mesh.testing import assert_paid
from tests.support.boards import DIMMER, LIBRARIES, ROOT, board, edge, firmware
from tests.support.market import offering

if TYPE_CHECKING:
    from pathlib import Path

    from mesh.agent.handlers import Job
    from mesh.testing import Market


LONG = 60.0
BUTTON = 2


async def test_a_lamp_is_dimmed_for_money_and_a_button_ends_the_job(market: Market) -> None:
    """The sketch knows pins and numbers from 0 to 255; the robot's code makes percents and a wish of it."""
    robot = offering(Agent())
    device, waiting = Device(robot, patience=LONG), asyncio.Event()

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

    wanted = [("/brightness", 25.0), ("/brightness", 50.0), ("/until_pressed", True)]
    async with market.robot(robot):
        with board(DIMMER) as uno, edge(uno.port, robot.address, market.endpoint):
            before = await market.balance(robot)
            contract = await market.demand(robot, wanted, cost=5)
            async with asyncio.timeout(LONG):
                await waiting.wait()
            uno.set_pin(BUTTON, False)
            assert_paid(outcome := await market.outcome(contract))
            assert await market.balance(robot) == before + 5
    assert [(dimming.pin, dimming.value) for dimming in uno.dimmings] == [(9, 64), (9, 128)]
    assert outcome.recording.values("/dim")[:2] == [64, 128]
    assert outcome.recording.values("/button") == [True]


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
