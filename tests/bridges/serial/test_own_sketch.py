"""A hobbyist's own sketch, with an input and a PWM output, works for money."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Any

from bridges.serial.device import Device
from mesh.recording import open_objective
from schemas.payloads import decode_value
from tests.support.boards import DIMMER, board, edge
from tests.support.market import founded, offering, place
from tests.support.objectives import objective

if TYPE_CHECKING:
    from mesh.work.job import Job
    from tests.support.market import Place

__all__ = ["founded", "place"]

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
