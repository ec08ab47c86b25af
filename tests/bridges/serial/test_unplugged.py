"""Rosserial boards whose cable is pulled during a command: what a job does depends on what the sketch lets it know."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Literal

import pytest

from bridges.serial._device import Device
from bridges.serial.dialect import BoardLost, CallStatus, CommandFinished
from bridges.serial.rosserial import RosserialDialect
from mesh import Agent
from schemas import Empty, String
from tests.support.boards import ROSSERIAL_ECHO, board, edge
from tests.support.lines import LineClient
from tests.support.market import offering
from tests.support.waiting import until

if TYPE_CHECKING:
    from bridges.serial.boards import SimulatedBoard
    from mesh.agent.handlers import Job
    from mesh.testing import Market


LONG = 60.0
WORK = "WORK=2000"
"""The lamp is on, then off, for so many milliseconds: long enough to pull the cable meanwhile on a busy machine."""


def flashes(uno: SimulatedBoard) -> int:
    """How often the lamp has gone out."""
    return sum(not change.high for change in uno.changes(13))


def unplug_during_a_command(uno: SimulatedBoard, *, reset: bool = False) -> None:
    """Pull the cable while the board is in its callback, some time after it has read the command."""
    uno.wait_until(lambda: flashes(uno) == 1, what="the first flash")
    uno.unplug()
    if reset:
        uno.reset()
    uno.plug()


@pytest.mark.full
def test_a_command_is_read_although_the_cable_was_pulled_in_its_callback() -> None:
    # On a busy machine the board runs slower than its line: allow it more time to announce its topics.
    patient = RosserialDialect(baud=57_600, settle_time=3.0)
    with board(ROSSERIAL_ECHO, WORK) as uno, LineClient(uno, patient) as client:
        client.submit("/work")
        client.submit("/work")
        unplug_during_a_command(uno)
        assert [client.next(CommandFinished).status for _ in range(2)] == [CallStatus.READ] * 2
        uno.wait_until(lambda: flashes(uno) == 2, what="the second flash")
        assert any(isinstance(event, BoardLost) for event in client.events)


def test_a_command_is_in_doubt_if_the_board_has_restarted() -> None:
    with board(ROSSERIAL_ECHO, WORK) as uno, LineClient(uno, RosserialDialect(baud=57_600)) as client:
        client.submit("/work")
        client.submit("/hear", String("next").encode())
        unplug_during_a_command(uno, reset=True)
        assert client.next(CommandFinished).reason == "doubt"
        assert client.next(CommandFinished).status is CallStatus.READ


def working(in_doubt: Literal["fail", "again"]) -> Agent:
    robot = offering(Agent())
    device = Device(robot, patience=LONG, in_doubt=in_doubt)

    @robot.on("/work", Empty)
    async def work(job: Job, message: Empty) -> None:
        await device.call("/work", job=job)

    return robot


@pytest.mark.sample("reset", "in_doubt", "success", "flashing")
@pytest.mark.parametrize(
    ("reset", "in_doubt", "success", "flashing"),
    [(False, "fail", True, 1), (True, "fail", False, 1), (True, "again", True, 2)],
    ids=["the board kept running", "the board was restarted", "what is in doubt is done again"],
)
async def test_a_job_waits_for_its_board_as_far_as_the_sketch_allows(
    market: Market, reset: bool, in_doubt: Literal["fail", "again"], success: bool, flashing: int
) -> None:
    async with market.robot(working(in_doubt)) as robot:
        with board(ROSSERIAL_ECHO, WORK) as uno, edge(uno.port, robot.address, market.endpoint):
            contract = await market.demand(robot, [("/work", Empty())], cost=1)
            await asyncio.to_thread(unplug_during_a_command, uno, reset=reset)
            outcome = await market.outcome(contract, timeout=LONG)
            await until(lambda: flashes(uno) == flashing, what="the flashes", seconds=LONG)
    assert outcome.success is success
    said = outcome.recording.values("/aira/device/board")
    absent = said.index("absent: the line is closed")
    if success:
        assert "present" in said[absent:]
    else:
        assert "(doubt)" in outcome.reason
