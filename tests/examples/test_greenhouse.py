"""The greenhouse: a robot and its client in a program of 40 lines that needs nothing but `mesh`."""

from __future__ import annotations

import ast
import asyncio
import sys
from pathlib import Path

from mypy import api

from tests.support.commands import AIRA, Serving, run
from tests.support.lessons import EXAMPLES, as_role, market
from tests.support.recordings import decoded, recordings_in
from tests.support.waiting import until

__all__ = ["market"]

PROGRAM = EXAMPLES / "greenhouse" / "greenhouse.py"


def test_the_program_is_short_and_needs_only_mesh_and_passes_mypy() -> None:
    text = PROGRAM.read_text()
    assert len(text.splitlines()) <= 40
    imported = [node for node in ast.walk(ast.parse(text)) if isinstance(node, ast.Import | ast.ImportFrom)]
    assert {node.module if isinstance(node, ast.ImportFrom) else node.names[0].name for node in imported} == {
        "sys",
        "mesh",
    }
    output, errors, status = api.run(["--strict", str(PROGRAM)])
    assert status == 0, output + errors


def test_two_jobs_at_once_one_of_which_fails_and_the_readings_beside_them(market: dict[str, str]) -> None:
    robot, watching = as_role("robot", market), {"AIRA_CONNECT": market["AIRA_CONNECT"]}
    with (
        Serving(*AIRA, "watch", "--readings", says="watching", variables=watching) as watch,
        Serving(sys.executable, PROGRAM, "robot", says="account 0x", variables=robot),
    ):
        done = run(sys.executable, PROGRAM, **as_role("person", market))
        asyncio.run(until(lambda: "reading    /tank  10.0, from 0x" in watch.log(), what="a reading"))
        asyncio.run(until(lambda: watch.log().count(" pays 5 XRT, model ") >= 2, what="both demands"))
        watched = watch.log()
    assert done.stdout.splitlines() == ["done", "the tank has 10 litres"], done.stderr
    assert watched.count(" pays 5 XRT, model ") == 2
    played = [decoded(path) for path in recordings_in(Path(market["AIRA_DATA_DIR"]))]
    assert {said.data for messages in played for topic, said in messages if topic == "/lit"} == {True}
