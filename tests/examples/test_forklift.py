"""The forklifts are what a reader can take in. That they work as their README says is in `tests/test_readmes.py`."""

from __future__ import annotations

import ast
import subprocess
import sys

from mypy import api

from tests.support.lessons import EXAMPLES

EXAMPLE = EXAMPLES / "forklift"
ROBOT, CLIENT = EXAMPLE / "forklift.py", EXAMPLE / "client.py"


def test_the_programs_are_short_and_need_only_mesh_and_no_address_and_pass_mypy() -> None:
    for program, lines in ((ROBOT, 60), (CLIENT, 30)):
        text = program.read_text()
        assert len(text.splitlines()) <= lines
        assert "0x" not in text
        imported = [node for node in ast.walk(ast.parse(text)) if isinstance(node, ast.Import | ast.ImportFrom)]
        names = {node.module if isinstance(node, ast.ImportFrom) else node.names[0].name for node in imported}
        assert names <= {"argparse", "asyncio", "pathlib", "mesh"}
        output, errors, status = api.run(["--strict", str(program)])
        assert status == 0, output + errors


def test_its_own_tests_are_twelve_lines_each_and_pass() -> None:
    tests = EXAMPLE / "test_forklift.py"
    assert all(len(ast.unparse(one).splitlines()) <= 12 for one in ast.parse(tests.read_text()).body)
    options = ("-q", "-p", "no:cacheprovider", "-o", "asyncio_mode=auto", "--rootdir", ".")
    ran = subprocess.run(
        [sys.executable, "-m", "pytest", *options, tests.name], cwd=EXAMPLE, capture_output=True, text=True
    )
    assert ran.returncode == 0, ran.stdout + ran.stderr
