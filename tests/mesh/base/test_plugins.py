"""Entry points of installed packages."""

from __future__ import annotations

import subprocess
import sys
from importlib import metadata
from typing import TYPE_CHECKING

import pytest

from mesh.base.extras import entry_points

if TYPE_CHECKING:
    from pathlib import Path

GROUPS = ("aira.commands", "aira.dialects", "aira.doctor_checks", "aira.pages", "console_scripts")


@pytest.mark.parametrize("group", GROUPS)
def test_the_entry_points_are_those_of_importlib_metadata(group: str) -> None:
    installed = reversed(list(metadata.entry_points(group=group)))
    expected = {entry.name: f"{entry.module}:{entry.attr}" for entry in installed}  # without extras, which say nothing
    assert {entry.name: entry.value for entry in entry_points(group).values()} == expected


def test_an_entry_point_is_loaded_and_names_its_package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    about = tmp_path / "a_package-1.0.dist-info"
    about.mkdir()
    (about / "entry_points.txt").write_text(
        "[other]\nx = a:b\n\n[test.group]\n# comment\njoin = os.path:join\nnone = os:x [extra]\n"
    )
    monkeypatch.syspath_prepend(str(tmp_path))
    found = entry_points("test.group")
    assert found["join"].load()("a", "b") == "a/b"
    assert (found["join"].package, found["none"].value) == ("a-package", "os:x")
    with pytest.raises(AttributeError):
        found["none"].load()


def test_reading_them_does_not_import_importlib_metadata() -> None:
    program = (
        "import sys; from mesh.base.extras import entry_points; entry_points('aira.dialects')['frames'].load();"
        "sys.exit('importlib.metadata' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", program], check=False).returncode == 0
