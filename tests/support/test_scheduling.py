from __future__ import annotations

import re
import sys
from collections import defaultdict
from pathlib import Path

import pytest

from tests.support.commands import run
from tests.support.scheduling import SECONDS

ROOT = Path(__file__).parents[2]
SETTINGS = """
[pytest]
addopts = --import-mode=importlib -p no:cacheprovider
asyncio_default_fixture_loop_scope = function
faulthandler_timeout = 60
faulthandler_exit_on_timeout = true
"""
CONFTEST = """
from tests.support import scheduling

scheduling.SECONDS["test_e.py"] = 60
scheduling.TOGETHER = ("folder",)

def pytest_xdist_make_scheduler(config, log):
    return scheduling.LongestFirst(config, log)
"""
QUICK = "def test_{}(): pass\n"
BREAKS_DOWN = "def test_breaks_down(): import os; os._exit(3)\n"


def outcomes(folder: Path, **modules: str) -> list[tuple[str, str, str]]:
    """Process, outcome and test, in the order in which two processes reported them."""
    for name, text in {"pytest.ini": SETTINGS, "conftest.py": CONFTEST}.items():
        (folder / name).write_text(text)
    for name, text in modules.items():
        file = folder / f"{name}.py"
        file.parent.mkdir(exist_ok=True)
        file.write_text(text)
    command = (sys.executable, "-m", "pytest", "-v", "-n", "2", "--dist", "loadfile", folder)
    done = run(*command, PYTHONPATH=str(ROOT))
    reported = re.findall(r"^\[(gw\d)\] .*(PASSED|FAILED) (?:\S+/)?(test_\S+)", done.stdout, re.MULTILINE)
    assert reported, done.stdout + done.stderr
    return reported


def test_each_file_runs_in_one_process_and_the_longest_first(tmp_path: Path) -> None:
    files = ("test_a", "test_b", "test_c", "folder/test_d", "test_e", "folder/test_f")
    reported = outcomes(tmp_path, **dict.fromkeys(files, "".join(QUICK.format(number) for number in range(3))))
    processes: dict[str, set[str]] = defaultdict(set)
    begun: dict[str, str] = {}
    for process, _, test in reported:
        file = test.split("::")[0]
        processes[file].add(process)
        begun.setdefault(process, file)
    assert processes.keys() == {f"{Path(name).name}.py" for name in files}
    assert all(len(found) == 1 for found in processes.values())
    assert processes["test_d.py"] == processes["test_f.py"], "a folder whose files share servers"
    assert "test_e.py" in begun.values()


def test_a_test_that_crashes_its_process_fails_once_and_the_others_run(tmp_path: Path) -> None:
    file = QUICK.format("before") + BREAKS_DOWN + QUICK.format("after")
    reported = outcomes(tmp_path, test_a=file, test_b=file, test_c=file)
    assert sorted((outcome, test) for _, outcome, test in reported) == [
        *(("FAILED", f"test_{letter}.py::test_breaks_down") for letter in "abc"),
        *(("PASSED", f"test_{letter}.py::test_{when}") for letter in "abc" for when in ("after", "before")),
    ]


@pytest.mark.parametrize("name", sorted(SECONDS))
def test_files_with_a_known_duration_exist(name: str) -> None:
    assert (ROOT / name).exists()
