"""The forklifts are what a reader can take in. That they work as their README says is in `tests/test_readmes.py`."""

from __future__ import annotations

import ast

from mypy import api

from tests.support.lessons import EXAMPLES

EXAMPLE = EXAMPLES / "forklift"
ROBOT, CLIENT = EXAMPLE / "robot.py", EXAMPLE / "client.py"


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
