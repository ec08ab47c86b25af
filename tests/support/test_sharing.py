from __future__ import annotations

import re
import sys
from collections import defaultdict
from itertools import chain
from pathlib import Path

import pytest

from tests.support.commands import run
from tests.support.sharing import SECONDS, TOGETHER

ROOT = Path(__file__).parents[2]
SETTINGS = """
[pytest]
addopts = --import-mode=importlib -p no:cacheprovider
asyncio_default_fixture_loop_scope = function
faulthandler_timeout = 3
faulthandler_exit_on_timeout = true
"""
SHARED_OUT = """
from tests.support.sharing import SECONDS, TOGETHER, Sharing

SECONDS["test_e.py"] = 60
TOGETHER["some"] = ("test_b.py", "folder/")

def pytest_xdist_make_scheduler(config, log):
    return Sharing(config, log)
"""
QUICK = "def test_{}(): pass\n"
BREAKS_DOWN = "def test_breaks_down(): import os; os._exit(3)\n"


def outcomes(folder: Path, **modules: str) -> list[tuple[str, str, str]]:
    """Process, outcome and test, in the order in which two processes told them."""
    for name, text in {"pytest.ini": SETTINGS, "conftest.py": SHARED_OUT}.items():
        (folder / name).write_text(text)
    for name, text in modules.items():
        file = folder / f"{name}.py"
        file.parent.mkdir(exist_ok=True)
        file.write_text(text)
    command = (sys.executable, "-m", "pytest", "-v", "-n", "2", "--dist", "loadfile", folder)
    done = run(*command, PYTHONPATH=str(ROOT))
    told = re.findall(r"^\[(gw\d)\] .*(PASSED|FAILED) (?:\S+/)?(test_\S+)", done.stdout, re.MULTILINE)
    assert told, done.stdout + done.stderr
    return told


def test_files_are_shared_out_whole_and_the_longest_first(tmp_path: Path) -> None:
    files = ("test_a", "test_b", "test_c", "folder/test_d", "test_e")
    told = outcomes(tmp_path, **dict.fromkeys(files, "".join(QUICK.format(number) for number in range(3))))
    processes: dict[str, set[str]] = defaultdict(set)
    begun: dict[str, str] = {}
    for process, _, test in told:
        file = test.split("::")[0]
        processes[file].add(process)
        begun.setdefault(process, file)
    assert processes.keys() == {f"{Path(name).name}.py" for name in files}
    assert all(len(found) == 1 for found in processes.values())
    assert processes["test_b.py"] == processes["test_d.py"], "these go together"
    assert "test_e.py" in begun.values()


def test_a_test_that_ends_its_process_fails_once_and_all_others_are_run(tmp_path: Path) -> None:
    file = QUICK.format("before") + BREAKS_DOWN + QUICK.format("after")
    told = outcomes(tmp_path, test_a=file, test_b=file, test_c=file)
    assert sorted((outcome, test) for _, outcome, test in told) == [
        *(("FAILED", f"test_{letter}.py::test_breaks_down") for letter in "abc"),
        *(("PASSED", f"test_{letter}.py::test_{when}") for letter in "abc" for when in ("after", "before")),
    ]


@pytest.mark.parametrize("name", sorted({*SECONDS, *chain(*TOGETHER.values())} - TOGETHER.keys()))
def test_what_is_told_apart_is_there(name: str) -> None:
    assert (ROOT / name).exists()
