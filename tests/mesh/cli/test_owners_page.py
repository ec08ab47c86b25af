"""The pages for owners: their commands run as printed, their settings load, and their tables are complete."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Final, get_args

import pytest

from mesh.base.hours import Hours
from mesh.settings import load
from mesh.settings.groups import OwnerEvent
from tests.support.commands import Serving

if TYPE_CHECKING:
    from tests.support.cli.served_chain import ServedChain
    from tests.support.routers import EmbeddedRouter

GUIDES: Final = Path(__file__).parents[3] / "docs" / "guides"
PAGE: Final = "".join((GUIDES / f"{name}.md").read_text() for name in ("owners", "robot-control", "notifications"))
ROBOT: Final = """
import asyncio
from mesh import Agent

async def main():
    async with Agent():
        print("at work", flush=True)
        await asyncio.Event().wait()

asyncio.run(main())
"""
COMMANDS: Final = re.findall(r"^    ((?:aira|openssl) (?!.*KEYFILE).+)$", PAGE, re.MULTILINE)
"""Those without a KEYFILE that a reader names."""


def test_every_command_of_the_page_runs(served: ServedChain, router: EmbeddedRouter, tmp_path: Path) -> None:
    served.finalize(served.create_liability(cost=5))
    robot, stranger = served.people["robot"].address, served.people["stranger"].address
    served.run_json("xrt", "transfer", stranger, "1wn", by="robot")  # there is state to back up
    path = f"{Path(sys.executable).parent}:{os.environ['PATH']}"
    variables = {**os.environ, **served.variables("robot"), "PATH": path, "AIRA_CONNECT": router.endpoint}
    assert len(COMMANDS) >= 15

    def run(commands: list[str]) -> None:
        for command in commands:
            line = command.replace("NEW-ADDRESS", stranger).replace("OLD-ADDRESS", robot)
            done = subprocess.run(
                line, shell=True, cwd=tmp_path, env=variables, capture_output=True, text=True, check=False
            )
            assert done.returncode == 0, (line, done.stderr)

    own = [command for command in COMMANDS if command.startswith("aira robot ")]
    assert len(own) == 5
    with Serving(sys.executable, "-c", ROBOT, says="at work", variables=variables):
        run(own)
    run([command for command in COMMANDS if command not in own])
    statement = (tmp_path / "statement.csv").read_text().splitlines()
    assert statement[0].startswith("time,month,block,liability,state,")
    assert len(statement) == 2


def test_the_settings_of_the_page_load(tmp_path: Path) -> None:
    file = tmp_path / "settings.toml"
    blocks = re.findall(r"```toml\n(.*?)```", PAGE, re.DOTALL)
    file.write_text("".join(block for block in blocks if not block.startswith("[topics")))
    settings = load(path=file, environ={})
    assert (settings.queue_limit, settings.least_price, len(settings.refuse)) == (3, "5", 1)
    assert [Hours.parse(text) for text in settings.hours]
    assert set(settings.notify_events) < set(get_args(OwnerEvent))


@pytest.mark.parametrize("event", get_args(OwnerEvent))
def test_the_page_explains_each_event(event: str) -> None:
    assert f"| `{event}` |" in PAGE
