"""Arduino sketches compiled for an Uno: `python -m bridges.serial.firmware SKETCH… -o FOLDER -L LIBRARIES`.

A sketch is a folder with a `.ino` file of its name. `LIBRARIES` is a folder of Arduino libraries, each with its `src`;
those of this project are in examples/firmware.
"""

from __future__ import annotations

import argparse
import re
import subprocess
import tempfile
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import TYPE_CHECKING, Final

from mesh.errors import AiraError, ConfigurationError, InputError
from mesh.running import fail

if TYPE_CHECKING:
    from collections.abc import Sequence

CORE: Final = Path("/usr/share/arduino/hardware/arduino/avr")
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
FUNCTION: Final = re.compile(r"^(?!static|inline)([A-Za-z_][\w:<>*& ]*\s[*&]?\w+\([^;{}()]*\))\s*\{", re.MULTILINE)
"""The head of a function at the beginning of a line; the Arduino IDE generates a prototype for it."""


class CompilationFailed(InputError, code="compilation-failed"):
    """A sketch does not compile; the text has the compiler's output."""


def compile_sketch(sketch: Path, elf: Path, *, libraries: Sequence[Path] = (), defines: Sequence[str] = ()) -> Path:
    """Compile the sketch in the folder `sketch` into `elf`, for an Uno. `defines` are as for the compiler's `-D`,
    `libraries` are folders of Arduino libraries.

    Raises `CompilationFailed`, and `ConfigurationError` if the tools are not installed.
    """
    source = sketch / f"{sketch.name}.ino"
    if not source.is_file():
        raise InputError(f"{sketch} is not a sketch: {source.name} is missing")
    if not CORE.is_dir():
        raise ConfigurationError("the Arduino core is not installed", hint="install gcc-avr avr-libc arduino-core-avr")
    includes = [CORE / "cores/arduino", CORE / "variants/standard", sketch]
    includes += [source for folder in libraries for source in sorted(folder.glob("*/src"))]
    flags = [*FLAGS, *(f"-D{define}" for define in defines), *(f"-I{path}" for path in includes)]
    elf.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix="aira-firmware-") as folder:
        generated = Path(folder) / "sketch.cpp"
        generated.write_text(as_cpp(source.read_text(encoding="utf-8"), source))
        core = CORE / "cores/arduino"
        sources = [generated, *sorted(core.glob("*.c")), *sorted(core.glob("*.cpp")), *sorted(core.glob("*.S"))]
        with ThreadPoolExecutor(2) as workers:
            main, *rest = workers.map(lambda source: _object(source, Path(folder), flags), sources)
        # An archive, as the Arduino IDE makes it, leaves out the parts of the core that the sketch does not use.
        archive = Path(folder) / "core.a"
        _run("avr-gcc-ar", "rcs", archive, *rest)
        _run("avr-gcc", *FLAGS, "-Wl,--gc-sections", "-fuse-linker-plugin", main, archive, "-lm", "-o", elf)
    return elf


def as_cpp(sketch: str, source: Path) -> str:
    """The C++ that the Arduino IDE generates from a sketch: functions may be used before they are defined."""
    first = FUNCTION.search(sketch)
    at = first.start() if first else len(sketch)
    prototypes = "".join(f"{head};\n" for head in FUNCTION.findall(sketch) if "aira::" not in head)
    line = sketch.count("\n", 0, at) + 1
    return f'#include <Arduino.h>\n{sketch[:at]}\n{prototypes}#line {line} "{source}"\n{sketch[at:]}'


def size_of(elf: Path) -> tuple[int, int]:
    """The bytes of flash and of RAM that a firmware uses, without the stack."""
    words = _run("avr-size", "-A", elf)
    sizes = {name: int(size) for name, size in re.findall(r"^\.(\w+)\s+(\d+)", words, re.MULTILINE)}
    return sizes["text"] + sizes.get("data", 0), sizes.get("data", 0) + sizes.get("bss", 0) + sizes.get("noinit", 0)


def _object(source: Path, folder: Path, flags: Sequence[str]) -> Path:
    compiled = folder / f"{source.name}.o"
    if source.suffix == ".cpp":
        _run("avr-g++", *flags, *CXX_FLAGS, "-c", source, "-o", compiled)
    else:
        more = ["-x", "assembler-with-cpp"] if source.suffix == ".S" else ["-std=gnu11"]
        _run("avr-gcc", *flags, *more, "-c", source, "-o", compiled)
    return compiled


def _run(*command: str | Path) -> str:
    try:
        done = subprocess.run([str(word) for word in command], capture_output=True, text=True, check=False)
    except FileNotFoundError:
        raise ConfigurationError(f"{command[0]} is not installed", hint="install gcc-avr and avr-libc") from None
    if done.returncode:
        raise CompilationFailed(f"{command[0]} failed:\n{done.stderr.strip()}")
    return done.stdout


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(description="Compile Arduino sketches for an Uno.")
    parser.add_argument("sketches", nargs="+", type=Path, metavar="SKETCH", help="a sketch's folder")
    parser.add_argument("-o", "--output", type=Path, required=True, help="folder of the ELF files")
    parser.add_argument("-L", "--libraries", type=Path, action="append", default=[], help="a folder of libraries")
    parser.add_argument("-D", "--define", action="append", default=[], help="a macro, NAME or NAME=VALUE")
    given = parser.parse_args()
    try:
        for sketch in given.sketches:
            elf = given.output / f"{sketch.resolve().name}.elf"
            compile_sketch(sketch.resolve(), elf, libraries=given.libraries, defines=given.define)
            flash, ram = size_of(elf)
            print(f"{elf}: {flash} bytes of flash, {ram} bytes of RAM")
    except AiraError as error:
        fail(error)


if __name__ == "__main__":
    main()
