"""Arduino libraries: which ones a sketch uses, and what of them is compiled.

A library has its sources in `src` and all folders below, or at its top and in `utility`. Other folders at the top, as
the packages of ros_lib, hold only headers.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Final

from mesh.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence
    from pathlib import Path

SOURCES: Final = (".c", ".cpp", ".S")
INCLUDE: Final = re.compile(r'^[ \t]*#[ \t]*include[ \t]*[<"]([^>"]+)[>"]', re.MULTILINE)
COMMENT: Final = re.compile(r'//[^\n]*|/\*.*?\*/|"(?:\\.|[^"\\\n])*"', re.DOTALL)
"""A comment; or a text, which may contain what looks like one."""


@dataclass(frozen=True)
class ArduinoLibrary:
    """The library in a folder."""

    folder: Path

    @cached_property
    def root(self) -> Path:
        """The folder of its headers."""
        below = self.folder / "src"
        return below if below.is_dir() and not any(self.folder.glob("*.h")) else self.folder

    @cached_property
    def includes(self) -> tuple[Path, ...]:
        """The folders in which the compiler looks for headers."""
        utility = self.root / "utility"
        return (self.root, utility) if utility.is_dir() else (self.root,)

    @cached_property
    def sources(self) -> tuple[Path, ...]:
        """The files to compile."""
        if self.root != self.folder:
            return tuple(source_files(self.root.rglob("*")))
        return tuple(path for folder in self.includes for path in source_files(folder.iterdir()))

    @cached_property
    def fits(self) -> bool:
        """Whether it is for AVR processors, as far as it says."""
        about = self.folder / "library.properties"
        text = about.read_text(encoding="utf-8", errors="replace") if about.is_file() else ""
        stated = re.search(r"^architectures=(.*)$", text, re.MULTILINE)
        return stated is None or bool({"*", "avr"} & {each.strip() for each in stated[1].split(",")})

    def find(self, header: str) -> Path | None:
        """The file that an `#include` of this library names."""
        return next((path for folder in self.includes if (path := folder / header).is_file()), None)


def source_files(paths: Iterable[Path]) -> list[Path]:
    """Those of these paths that are compiled, sorted."""
    return sorted(path for path in paths if path.suffix in SOURCES and path.is_file())


def libraries_in(folders: Sequence[Path]) -> list[ArduinoLibrary]:
    """The libraries in these folders; a folder may also be a library itself. Raises `InputError` if one is missing."""
    found = []
    for folder in folders:
        if not folder.is_dir():
            raise InputError(f"the folder of libraries {folder} is missing")
        is_library = (folder / "library.properties").is_file() or any(folder.glob("*.h"))
        inside = [folder] if is_library else sorted(path for path in folder.iterdir() if path.is_dir())
        found += [library for each in inside if (library := ArduinoLibrary(each)).fits]
    return found


def used_libraries(
    sources: Iterable[Path], libraries: Sequence[ArduinoLibrary], *, folders: Sequence[Path]
) -> list[ArduinoLibrary]:
    """The libraries whose headers these sources include, directly or through others; `folders` have headers, too.

    If several libraries have a header, that with the header's name is used, otherwise the first one. What the
    preprocessor would leave out counts as well.
    """
    used: list[ArduinoLibrary] = []
    waiting = list(sources)
    seen = set(waiting)
    while waiting:
        source = waiting.pop()
        for header in INCLUDE.findall(without_comments(source.read_text(encoding="utf-8", errors="replace"))):
            found = next((path for folder in (source.parent, *folders) if (path := folder / header).is_file()), None)
            found = found or next((path for library in used if (path := library.find(header))), None)
            reached = [found] if found else []
            if found is None and (library := _library_of(header, libraries)) is not None:
                used.append(library)
                reached = [library.find(header), *library.sources]
            for path in reached:
                if path is not None and path not in seen:
                    seen.add(path)
                    waiting.append(path)
    return used


def without_comments(source: str) -> str:
    """The same source with blanks in place of its comments: lines and columns stay."""

    def blank(found: re.Match[str]) -> str:
        return found[0] if found[0].startswith('"') else re.sub(r"[^\n]", " ", found[0])

    return COMMENT.sub(blank, source)


def _library_of(header: str, libraries: Sequence[ArduinoLibrary]) -> ArduinoLibrary | None:
    having = [library for library in libraries if library.find(header) is not None]
    stem = header.rpartition("/")[2].removesuffix(".h")
    return next((library for library in having if library.folder.name == stem), having[0] if having else None)
