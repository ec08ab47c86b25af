"""The firmware libraries as the Arduino IDE takes them."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

import pytest

from bridges.serial.firmware import size_of
from tests.support.boards import LIBRARIES, firmware

if TYPE_CHECKING:
    from pathlib import Path

FOLDERS = sorted(LIBRARIES.glob("*/library.properties"))
FIELDS = {"name", "version", "author", "maintainer", "sentence", "paragraph", "category", "architectures", "includes"}


@pytest.fixture(params=[path.parent for path in FOLDERS], ids=[path.parent.name for path in FOLDERS])
def library(request: pytest.FixtureRequest) -> Path:
    """The folder of a library."""
    folder: Path = request.param
    return folder


def test_a_library_has_the_properties_that_the_ide_needs(library: Path) -> None:
    properties = dict(line.split("=", 1) for line in (library / "library.properties").read_text().splitlines())
    assert properties.keys() >= FIELDS
    assert properties["name"] == library.name
    assert (library / "src" / properties["includes"]).is_file()
    for number in properties["version"].split("."):
        assert number.isdecimal()


def test_its_keywords_are_those_of_its_header(library: Path) -> None:
    source = (library / "src" / f"{library.name}.h").read_text()
    for line in (library / "keywords.txt").read_text().splitlines():
        word, kind = line.split("\t")
        assert kind in {"KEYWORD1", "KEYWORD2", "LITERAL1"}
        assert re.search(rf"\b{word}\b", source), word


def test_its_examples_compile_and_fit_an_uno(library: Path) -> None:
    sketches = sorted(library.glob("examples/*/*.ino"))
    assert sketches
    for sketch in sketches:
        flash, ram = size_of(firmware(str(sketch.parent)))
        assert 0 < flash < 32_256
        assert 0 < ram < 2048
