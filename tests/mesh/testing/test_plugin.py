"""The pytest plugin: what it loads, and what a reader of a failed test sees."""

from __future__ import annotations

import subprocess
import sys
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pathlib import Path

HEAVY = ("zenoh", "web3", "eth", "mesh.agent", "mesh.testing._market")
TEST = """
from mesh import Agent
from mesh.testing import assert_paid

async def order(market):
    robot = Agent()
    robot.on("/lift", float)(lambda job, metres: 1 / (metres - 1))

    @robot.on_demand
    async def offer(demand):
        await robot.offer(demand)

    async with market.robot(robot):
        return await market.order(robot, [("/lift", 1.0)], cost="5 XRT")

async def test_fails(market):
    assert_paid(await order(market))

async def test_passes(market):
    assert not (await order(market)).success
"""


def test_it_loads_nothing_heavy_until_a_fixture_is_used() -> None:
    program = f"import sys, mesh.testing._plugin; sys.exit(any(name in sys.modules for name in {HEAVY}))"
    assert subprocess.run([sys.executable, "-c", program], check=False).returncode == 0


def test_the_log_of_agents_is_shown_for_the_test_that_fails_only(tmp_path: Path) -> None:
    (tmp_path / "conftest.py").write_text("from mesh.testing._plugin import market, market_chain\n")
    (tmp_path / "test_it.py").write_text(TEST)
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "-o", "asyncio_mode=auto"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=120, check=False)

    assert "1 failed, 1 passed" in done.stdout, done.stdout + done.stderr
    assert "the robot was not paid: ZeroDivisionError: float division by zero [handler-failed]" in done.stdout
    assert done.stdout.count("the job failed: ZeroDivisionError") == 1
    assert done.stdout.count("Captured log call") == 1
