"""The rover: its description is that of its program, and what the model excludes is not ordered."""

from __future__ import annotations

import re
import sys
from typing import TYPE_CHECKING

import pytest

from mesh.agent.objectives import ObjectiveUnfit
from mesh.recording import open_objective
from schemas import cid_of_file
from schemas.model import read_description
from tests.support.commands import AIRA, Serving, aira, run
from tests.support.lessons import EXAMPLES, as_role, market

if TYPE_CHECKING:
    import subprocess
    from pathlib import Path

__all__ = ["market"]

EXAMPLE = EXAMPLES / "rover"
MODEL = EXAMPLE / "model.json"


@pytest.fixture
def objectives(tmp_path: Path) -> dict[str, Path]:
    """An objective of each file of messages."""
    packed = {name: tmp_path / f"{name}.mcap" for name in ("drive", "too-fast")}
    for name, path in packed.items():
        assert aira("objective", "pack", EXAMPLE / f"{name}.jsonl", "--out", path).returncode == 0
    return packed


def test_the_description_is_that_of_the_program(tmp_path: Path) -> None:
    written = tmp_path / "model.json"
    assert aira("model", "new", EXAMPLE / "robot.py", "--out", written).returncode == 0
    assert written.read_bytes() == MODEL.read_bytes()


def test_the_docs_show_the_program() -> None:
    (shown,) = re.findall(
        r"```python\n(.*?)```", (EXAMPLES.parent / "docs" / "guides" / "describe-a-robot.md").read_text(), re.DOTALL
    )
    assert shown == (EXAMPLE / "robot.py").read_text()


@pytest.mark.full
def test_a_job_that_fits_is_paid_and_another_one_is_not_ordered(
    market: dict[str, str], objectives: dict[str, Path], tmp_path: Path
) -> None:
    def demand(name: str, out: Path) -> subprocess.CompletedProcess[str]:
        words = ("--cost", "5 XRT", "--model", cid_of_file(MODEL), "--objective", objectives[name], "--out", out)
        return run(*AIRA, "demand", *words, **as_role("person", market))

    out = tmp_path / "result.mcap"
    with Serving(sys.executable, EXAMPLE / "robot.py", says="account 0x", variables=as_role("robot", market)) as robot:
        done = demand("drive", out)
        assert "paid" in done.stdout, done.stderr + robot.log()
        files = (out, "--objective", objectives["drive"], "--checks", EXAMPLE / "validator.py")
        judged = aira("validator", "check", *files, "--data-dir", tmp_path / "data")
        assert judged.returncode == 0, judged.stdout + judged.stderr
        assert "holds  distance/check" in judged.stdout
        unfit = demand("too-fast", tmp_path / "other.mcap")
        assert unfit.returncode == 2
        assert "unfit-message" in unfit.stderr
        assert f"[{ObjectiveUnfit.code}]" in unfit.stderr
        assert "posted" not in unfit.stdout
        assert aira("order", "list", **as_role("person", market)).stdout.count("demand") == 0
    driven = [message for message in open_objective(out).messages() if message.topic == "/driven"]
    assert len(driven) == 2


def test_the_objectives_fit_or_not(objectives: dict[str, Path]) -> None:
    assert read_description(MODEL.read_bytes()).title == "Rover"
    assert aira("model", "check", MODEL, objectives["drive"]).returncode == 0
    assert aira("model", "check", MODEL, objectives["too-fast"]).returncode == 1
