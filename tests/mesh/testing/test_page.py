"""The programs in the pages on testing, run by pytest as a reader's."""

from __future__ import annotations

import re
import subprocess
import sys
from importlib.metadata import entry_points
from pathlib import Path

import pytest

from tests.support.commands import environment

GUIDES = Path(__file__).parents[3] / "docs" / "guides"
PAGES = (GUIDES / "testing.md", GUIDES / "testing-market.md")


@pytest.fixture
def programs() -> list[str]:
    text = "".join(page.read_text(encoding="utf-8") for page in PAGES)
    return re.findall(r"^```python\n(.*?)^```", text, re.MULTILINE | re.DOTALL)


def test_the_tests_of_the_page_pass(programs: list[str], tmp_path: Path) -> None:
    robot, *tests = programs
    (tmp_path / "robot.py").write_text(robot)
    for number, test in enumerate(tests):
        (tmp_path / f"test_{number}.py").write_text(test)
    (tmp_path / "pyproject.toml").write_text('[tool.pytest.ini_options]\nasyncio_mode = "auto"\npythonpath = ["."]\n')
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider"]
    if not entry_points(group="pytest11", name="aira"):  # this tree was installed before it had the plugin
        command += ["-p", "mesh.testing._plugin"]
    variables = environment({"HOME": str(tmp_path)})
    done = subprocess.run(
        command, cwd=tmp_path, env=variables, capture_output=True, text=True, timeout=120, check=False
    )

    passed = sum(len(re.findall(r"^async def test_", test, re.MULTILINE)) for test in tests)
    assert done.stdout.splitlines()[-1].startswith(f"{passed} passed"), done.stdout + done.stderr
