"""The registry of dialects."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from bridges.serial.dialect import Dialect, dialect_names, load_dialect
from bridges.serial.errors import BrokenDialect, UnknownDialect

if TYPE_CHECKING:
    from pathlib import Path


def test_the_dialects_of_this_package_are_installed() -> None:
    assert {"frames", "rosserial"} <= set(dialect_names())
    for name in dialect_names():
        dialect = load_dialect(name)(baud=57_600, parameters={"rate": 7})
        assert isinstance(dialect, Dialect)
        assert dialect.info is None


def test_an_unknown_dialect_is_refused_with_those_that_are_installed() -> None:
    with pytest.raises(UnknownDialect) as caught:
        load_dialect("morse")
    assert (caught.value.code, caught.value.name) == ("unknown-dialect", "morse")
    assert {"frames", "rosserial"} <= set(caught.value.known)


def test_an_installed_package_adds_a_dialect(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    about = tmp_path / "morse-1.0.dist-info"
    about.mkdir()
    (about / "entry_points.txt").write_text(
        "[aira.dialects]\nmorse = bridges.serial.frames_dialect:FramesDialect\nodd = os:no_such_dialect\n"
    )
    monkeypatch.syspath_prepend(str(tmp_path))
    assert "morse" in dialect_names()
    assert load_dialect("morse").__name__ == "FramesDialect"
    with pytest.raises(BrokenDialect) as caught:
        load_dialect("odd")
    assert (caught.value.code, caught.value.package) == ("dialect-broken", "morse")
