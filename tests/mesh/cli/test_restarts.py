"""`aira up` is started again while a robot runs: the robot waits, and then works on the chain that is there."""

from __future__ import annotations

import asyncio
import signal
import sys
from typing import TYPE_CHECKING

import pytest

from mesh.chain import Chain, NodeUnreachable, Timing
from tests.support.commands import AIRA, Serving, aira, environment
from tests.support.objectives import objective
from tests.support.peers import require
from tests.support.ports import free_port

if TYPE_CHECKING:
    from pathlib import Path

MODEL = "QmTH8nmTYpLtoMXvrkG18CeKBcT926SBYLCTjiGmvtLE82"
ROBOT = f"""
from mesh import Agent
agent = Agent("{MODEL}")
@agent.on_demand
async def offer(demand):
    await agent.offer(demand)
@agent.on("/go")
async def go(job, message):
    job.publish("/went", "there")
agent.run()
"""


@pytest.mark.full
@pytest.mark.sample("kept")
@pytest.mark.parametrize("kept", [False, True], ids=["a new chain", "the same chain"])
def test_a_running_robot_survives_a_restart_of_the_market(tmp_path: Path, kept: bool) -> None:
    (tmp_path / "robot.py").write_text(ROBOT)
    (tmp_path / "objective.mcap").write_bytes(objective(("/go", "there")))
    endpoint, port, data = f"tcp/127.0.0.1:{free_port()}", str(free_port()), tmp_path / "data"
    engine = ("--anvil", require("anvil"), "--state", tmp_path / "chain.json") if kept else ("--engine", "embedded")
    words = ("up", "--port", port, "--listen", endpoint, "--data-dir", data, *engine)
    keys = data / "development"
    shared = {
        "AIRA_CONNECT": endpoint,
        "AIRA_WEB3_HTTP_PROVIDER": f"http://127.0.0.1:{port}",
        "AIRA_DATA_DIR": str(data),
        "AIRA_KEYFILE_PASSWORD_FILE": str(keys / "password"),
    }
    person = shared | {"AIRA_KEYFILE": str(keys / "person.json")}
    robot_settings = shared | {"AIRA_KEYFILE": str(keys / "robot.json")}
    market = Serving(*AIRA, *words, says="provider    0x")
    with market, Serving(sys.executable, tmp_path / "robot.py", says="account 0x", variables=robot_settings) as robot:
        for time in range(2):
            demand = ("--model", MODEL, "--objective", tmp_path / "objective.mcap", "--cost", "1", "--json")
            done = aira("demand", *demand, **person)
            assert done.returncode == 0, (time, done.stderr, robot.log(), market.log())
            if time == 0:
                market.end(signal.SIGINT)
                market.start()
        assert robot.is_running
        assert ("the chain was started afresh" in robot.log()) is not kept


@pytest.mark.parametrize("engine", ["anvil", "embedded"])
async def test_the_port_opens_when_the_contracts_are_there(
    tmp_path: Path, engine: str, on_path: dict[str, str]
) -> None:
    port = free_port()
    words = ("chain", "up", "--engine", engine, "--port", str(port), "--data-dir", tmp_path / "data")
    process = await asyncio.create_subprocess_exec(*AIRA, *words, env=environment(on_path))
    try:
        while True:
            assert process.returncode is None
            try:
                async with Chain(f"http://127.0.0.1:{port}", timing=Timing(attempts=1)) as chain:
                    assert len(await chain.lighthouses.list()) == 1
                    assert (await chain.lighthouses.get("airalab")).stakes
                    break
            except NodeUnreachable:
                await asyncio.sleep(0.01)
    finally:
        process.terminate()
        await process.wait()
