"""Arduino sketches compiled for an Uno: `python -m bridges.serial.firmware SKETCH… -o FOLDER -L LIBRARIES`.

A sketch is a folder with a `.ino` file of its name; other sources in the folder, and in its `src`, belong to it.
`LIBRARIES` is a folder of Arduino libraries, as the Arduino IDE has, or a library; those that the sketch includes are
compiled. The libraries of this project are in examples/firmware; those of the Arduino core are always found.

A library has its sources in `src` and all folders below, or at its top and in `utility`. Other folders at the top, as
the packages of ros_lib, hold only headers.
"""

from __future__ import annotations

import argparse
import hashlib
import os
import re
import subprocess
import tempfile
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Final

from mesh.errors import AiraError, ConfigurationError, InputError
from mesh.role.running import fail

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence


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


CORE: Final = Path("/usr/share/arduino/hardware/arduino/avr")
CORE_INCLUDES: Final = (CORE / "cores/arduino", CORE / "variants/standard")
SKETCHES: Final = (".ino", ".pde")
"""How the files of a sketch end; the second one is that of the IDE before 1.0."""
FLAGS: Final = (
    "-mmcu=atmega328p",
    "-DF_CPU=16000000L",
    "-DARDUINO=10819",
    "-DARDUINO_AVR_UNO",
    "-DARDUINO_ARCH_AVR",
    "-DDECIMAL_DIG=__DECIMAL_DIG__",
    "-Os",
    "-w",
    "-flto",
    "-ffunction-sections",
    "-fdata-sections",
)
CXX_FLAGS: Final = ("-std=gnu++11", "-fno-exceptions", "-fno-threadsafe-statics", "-fpermissive")
FUNCTION: Final = re.compile(
    r"^(?!(?:static|inline|else|return|template|typedef)\b)"
    r"([A-Za-z_][\w:<>*& ]*[\s*&]\s*(?!(?:if|while|for|switch)\b)\w+\s*\([^;{}()=]*\))\s*\{",
    re.MULTILINE,
)
"""The head of a function at the beginning of a line, without default arguments; the IDE makes a prototype of it."""


def compile_sketch(sketch: Path, elf: Path, *, libraries: Sequence[Path] = (), defines: Sequence[str] = ()) -> Path:
    """Compile the sketch in the folder `sketch` into `elf`, for an Uno. `defines` are as for the compiler's `-D`,
    `libraries` are Arduino libraries and folders of them.

    Raises `InputError` for what does not compile, is missing or no sketch, and `ConfigurationError` if the
    tools are not installed.
    """
    written = sketch_files(sketch)
    if not CORE.is_dir():
        raise ConfigurationError("the Arduino core is not installed", hint="install gcc-avr avr-libc arduino-core-avr")
    includes = [*CORE_INCLUDES, sketch]
    own = source_files([*sketch.iterdir(), *(sketch / "src").rglob("*")])
    available = libraries_in([*libraries, CORE / "libraries"])
    used = used_libraries([*written, *own], available, folders=[*includes, Path("/usr/lib/avr/include")])
    includes += [folder for library in used for folder in library.includes]
    macros = [f"-D{define}" for define in defines]
    core = compiled_core(macros)
    elf.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix="aira-firmware-") as folder:
        generated = Path(folder) / "sketch.cpp"
        generated.write_text(as_cpp(written), encoding="utf-8")
        parts = [generated, *own, *(source for library in used for source in library.sources)]
        made = _objects(parts, Path(folder), [*macros, *(f"-I{path}" for path in includes)])
        _run("avr-gcc", *FLAGS, "-Wl,--gc-sections", "-fuse-linker-plugin", *made, core, "-lm", "-o", elf)
    return elf


def cache_folder() -> Path:
    """The folder that `make peers` also uses; it may be deleted at any time."""
    return Path(os.environ.get("AIRA_PEERS_CACHE") or "~/.cache/aira-mesh").expanduser()


def compiled_core(macros: Sequence[str]) -> Path:
    """The Arduino core, compiled with these macros: an archive, of which the linker takes only what a sketch uses.

    It is kept in the cache folder, as compiling it takes most of the time.
    """
    sources = source_files((CORE / "cores/arduino").iterdir())
    parts = [*FLAGS, *CXX_FLAGS, *macros, _run("avr-gcc", "--version"), *map(str, sources)]
    archive = cache_folder() / f"core-{hashlib.sha256(' '.join(parts).encode()).hexdigest()[:12]}.a"
    if not archive.exists():
        archive.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=archive.parent) as folder:
            made = _objects(sources, Path(folder), [*macros, *(f"-I{path}" for path in CORE_INCLUDES)])
            _run("avr-gcc-ar", "rcs", Path(folder) / "core.a", *made)
            (Path(folder) / "core.a").replace(archive)
    return archive


def sketch_files(sketch: Path) -> list[Path]:
    """The `.ino` files in the folder of a sketch: first that with its name. Raises `InputError` if there is none."""
    main = [path for suffix in SKETCHES if (path := sketch / f"{sketch.name}{suffix}").is_file()]
    if not main:
        hint = "the folder of a sketch and its file have the same name, as in lamp/lamp.ino"
        raise InputError(f"{sketch} is not a sketch: {sketch.name}.ino is missing", hint=hint)
    others = sorted(path for path in sketch.iterdir() if path.suffix == main[0].suffix and path != main[0])
    return [main[0], *others]


def as_cpp(files: Sequence[Path]) -> str:
    """The C++ that the Arduino IDE generates from a sketch: functions may be used before they are defined."""
    text = "".join(f'#line 1 "{path}"\n{path.read_text(encoding="utf-8")}\n' for path in files)
    heads = list(FUNCTION.finditer(without_comments(text)))
    at = heads[0].start() if heads else len(text)
    prototypes = "".join(f"{head[1]};\n" for head in heads)
    file = text[text.rindex("#line 1 ", 0, at) : at]
    name = file.partition("\n")[0].removeprefix("#line 1 ")
    line = file.count("\n")
    return f"#include <Arduino.h>\n{text[:at]}\n{prototypes}#line {line} {name}\n{text[at:]}"


def size_of(elf: Path) -> tuple[int, int]:
    """The bytes of flash and of RAM that a firmware uses, without the stack."""
    words = _run("avr-size", "-A", elf)
    sizes = {name: int(size) for name, size in re.findall(r"^\.(\w+)\s+(\d+)", words, re.MULTILINE)}
    return sizes["text"] + sizes.get("data", 0), sizes.get("data", 0) + sizes.get("bss", 0) + sizes.get("noinit", 0)


def _objects(sources: Sequence[Path], folder: Path, flags: Sequence[str]) -> list[Path]:

    def compiled(source: Path, into: Path) -> Path:
        if source.suffix == ".cpp":
            _run("avr-g++", *FLAGS, *flags, *CXX_FLAGS, "-c", source, "-o", into)
        else:
            language = ["-x", "assembler-with-cpp"] if source.suffix == ".S" else ["-std=gnu11"]
            _run("avr-gcc", *FLAGS, *flags, *language, "-c", source, "-o", into)
        return into

    with ThreadPoolExecutor(2) as workers:
        return list(workers.map(compiled, sources, (folder / f"{number}.o" for number in range(len(sources)))))


def _run(*command: str | Path) -> str:
    try:
        done = subprocess.run([str(word) for word in command], capture_output=True, text=True, check=False)
    except FileNotFoundError:
        raise ConfigurationError(f"{command[0]} is not installed", hint="install gcc-avr and avr-libc") from None
    if done.returncode:
        lacks = re.search(r"fatal error: (\S+): No such file", done.stderr)
        hint = f"-L FOLDER names a folder that has the library with {lacks[1]}" if lacks else ""
        raise InputError(f"{command[0]} failed:\n{done.stderr.strip()}", hint=hint, code="compilation-failed")
    return done.stdout


def main() -> None:
    parser = argparse.ArgumentParser(description="Compile Arduino sketches for an Uno.")
    parser.add_argument("sketches", nargs="+", type=Path, metavar="SKETCH", help="a sketch's folder or its .ino file")
    parser.add_argument("-o", "--output", type=Path, required=True, help="folder of the ELF files")
    parser.add_argument(
        "-L", "--libraries", type=Path, action="append", default=[], help="a library, or a folder of libraries"
    )
    parser.add_argument("-D", "--define", action="append", default=[], help="a macro, NAME or NAME=VALUE")
    given = parser.parse_args()
    try:
        for path in map(Path.resolve, given.sketches):
            sketch = path.parent if path.suffix in SKETCHES else path
            elf = given.output / f"{sketch.name}.elf"
            compile_sketch(sketch, elf, libraries=given.libraries, defines=given.define)
            flash, ram = size_of(elf)
            print(f"{elf}: {flash} bytes of flash, {ram} bytes of RAM")
    except AiraError as error:
        fail(error)


if __name__ == "__main__":
    main()
