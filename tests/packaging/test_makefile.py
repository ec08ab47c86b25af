"""The Makefile on a machine whose Python is too old."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
OLD = """#!/bin/sh
case "$1" in --version) echo Python 3.10.2;; *) exit 1;; esac
"""


@pytest.mark.parametrize("target", ["demo", "peers"])
def test_an_old_python_is_named_before_anything_is_done(tmp_path: Path, target: str) -> None:
    for file in ("Makefile", "pyproject.toml", "requirements/lock.txt"):
        (tmp_path / file).parent.mkdir(exist_ok=True)
        shutil.copy(ROOT / file, tmp_path / file)
    old = tmp_path / "python3.10"
    old.write_text(OLD)
    old.chmod(0o755)
    done = subprocess.run(["make", target, f"PYTHON={old}"], cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 2
    assert f"Python 3.11 or later is needed, and {old} is: Python 3.10.2" in done.stderr
    assert not (tmp_path / ".venv").exists()
