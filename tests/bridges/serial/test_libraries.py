"""Sketches that use Arduino libraries: which are found, in both layouts, and what of a sketch's folder is compiled."""

from __future__ import annotations

import subprocess
import sys
from typing import TYPE_CHECKING

import pytest

from bridges.serial.boards import SimulatedBoard
from bridges.serial.firmware import CompilationFailed, compile_sketch
from mesh.errors import InputError
from tests.support.boards import COUNTER, firmware

if TYPE_CHECKING:
    from pathlib import Path

PIN = 13


def files(folder: Path, **sources: str) -> Path:
    """Write files, named by their paths with `__` for `/` and `_dot_` for the last dot."""
    for name, text in sources.items():
        path = folder / name.replace("__", "/").replace("_dot_", ".")
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    return folder


def lights(sketch: Path, *libraries: Path) -> bool:
    """Whether the compiled sketch lights the lamp, which says that everything was linked and runs."""
    firmware(COUNTER)  # skips the test where the tools are missing
    elf = compile_sketch(sketch, sketch / "out" / "made.elf", libraries=libraries)
    with SimulatedBoard(elf) as uno:
        uno.wait_until(lambda: uno.changes(PIN) and uno.changes(PIN)[-1].high, what="the lamp")
    return True


def sketch_using(folder: Path, *headers: str, then: str) -> Path:
    includes = "".join(f"#include <{header}>\n" for header in headers)
    source = f"{includes}void setup() {{ pinMode({PIN}, OUTPUT); {then}; }}\nvoid loop() {{}}\n"
    return files(folder / "lamp", lamp_dot_ino=source)


def test_a_library_has_its_sources_at_the_top_and_in_utility(tmp_path: Path) -> None:
    files(
        tmp_path / "libraries" / "Lamp",
        Lamp_dot_h="#pragma once\nvoid light(int pin);\n",
        Lamp_dot_cpp='#include <Arduino.h>\n#include "Lamp.h"\n#include "level.h"\n'
        "void light(int pin) { digitalWrite(pin, level()); }\n",
        utility__level_dot_h='#pragma once\n#ifdef __cplusplus\nextern "C"\n#endif\nint level(void);\n',
        utility__level_dot_c='#include "level.h"\nint level(void) { return 1; }\n',
        examples__broken_dot_cpp="this is not compiled\n",
    )
    assert lights(sketch_using(tmp_path, "Lamp.h", then=f"light({PIN})"), tmp_path / "libraries")


def test_a_library_in_the_newer_layout_is_compiled_with_the_folders_below_src(tmp_path: Path) -> None:
    files(
        tmp_path / "libraries" / "Lamp",
        library_dot_properties="name=Lamp\n",
        src__Lamp_dot_h="#pragma once\nvoid light(int pin);\n",
        src__deep__light_dot_cpp="#include <Arduino.h>\n#include <Lamp.h>\n"
        "void light(int pin) { digitalWrite(pin, 1); }\n",
    )
    assert lights(sketch_using(tmp_path, "Lamp.h", then=f"light({PIN})"), tmp_path / "libraries")


def test_the_layout_of_ros_lib_has_packages_as_folders(tmp_path: Path) -> None:
    files(
        tmp_path / "libraries" / "ros_lib",
        ros_dot_h='#pragma once\n#include "ros/time.h"\n#include "std_msgs/Level.h"\n',
        ros__time_dot_h="#pragma once\nnamespace ros { int now(); }\n",
        std_msgs__Level_dot_h="#pragma once\nnamespace std_msgs { struct Level { int data; }; }\n",
        time_dot_cpp='#include "ros/time.h"\nnamespace ros { int now() { return 1; } }\n',
        tests__unit_dot_cpp="this is not compiled\n",
    )
    then = f"std_msgs::Level level = {{ros::now()}}; digitalWrite({PIN}, level.data)"
    assert lights(sketch_using(tmp_path, "ros.h", "std_msgs/Level.h", then=then), tmp_path / "libraries")


def test_a_library_that_another_one_uses_is_found_and_the_unused_are_left_alone(tmp_path: Path) -> None:
    libraries = tmp_path / "libraries"
    files(libraries / "Wifi", Wifi_dot_h="#error for another board\n", Wifi_dot_cpp="#error for another board\n")
    files(libraries / "Low", Low_dot_h="int low();\n", Low_dot_cpp="int low() { return 1; }\n")
    files(
        libraries / "High", High_dot_h="int high();\n", High_dot_cpp="#include <Low.h>\nint high() { return low(); }\n"
    )
    assert lights(sketch_using(tmp_path, "High.h", then=f"digitalWrite({PIN}, high())"), libraries)


def test_a_library_is_preferred_by_its_name_and_may_be_given_itself(tmp_path: Path) -> None:
    files(tmp_path / "one" / "Also", Lamp_dot_h="#error not this one\n")
    files(tmp_path / "one" / "Lamp", Lamp_dot_h="const int LEVEL = 1;\n")
    sketch = sketch_using(tmp_path, "Lamp.h", then=f"digitalWrite({PIN}, LEVEL)")
    assert lights(sketch, tmp_path / "one")
    assert lights(sketch, tmp_path / "one" / "Lamp")


def test_the_cores_own_libraries_need_no_folder(tmp_path: Path) -> None:
    then = f"EEPROM.write(0, 1); Wire.begin(); digitalWrite({PIN}, EEPROM.read(0))"
    assert lights(sketch_using(tmp_path, "EEPROM.h", "Wire.h", then=then))


def test_all_sources_of_the_sketchs_folder_belong_to_it(tmp_path: Path) -> None:
    sketch = files(
        tmp_path / "lamp",
        lamp_dot_ino='#include "level.h"\nvoid setup() { begin(); light(PIN); }\nvoid loop() {}\n',
        light_dot_ino="/*\nUnknown gone() {\n*/\nvoid put(int pin, int to = level()) {\ndigitalWrite(pin, to);\n}\n"
        "void light(int pin) {\nput(pin);\n}\n",
        begin_dot_cpp='#include <Arduino.h>\n#include "level.h"\nvoid begin() { pinMode(PIN, OUTPUT); }\n',
        level_dot_h=f"#pragma once\nconst int PIN = {PIN};\nvoid begin();\nint level();\n",
        src__deep__level_dot_cpp="int level() { return 1; }\n",
    )
    assert lights(sketch)


def test_a_sketch_of_an_old_ide_ends_with_pde(tmp_path: Path) -> None:
    sketch = files(tmp_path / "old", old_dot_pde=f"void setup() {{ digitalWrite({PIN}, 1); }}\nvoid loop() {{}}\n")
    firmware(COUNTER)
    assert compile_sketch(sketch, tmp_path / "old.elf").exists()


def test_unindented_code_is_no_function(tmp_path: Path) -> None:
    code = (
        "void setup() {\nif(millis()) {\n}\nelse if(micros()) {\n}\nwhile(false) {\n}\n}\n"
        "void loop() { last (); }\nvoid last () {\n}\n"
    )
    firmware(COUNTER)
    assert compile_sketch(files(tmp_path / "flat", flat_dot_ino=code), tmp_path / "flat.elf").exists()


def test_a_library_that_is_missing_is_named_and_a_folder_without_libraries_too(tmp_path: Path) -> None:
    firmware(COUNTER)
    sketch = sketch_using(tmp_path, "Nowhere.h", then="")
    with pytest.raises(CompilationFailed, match=r"Nowhere\.h") as raised:
        compile_sketch(sketch, tmp_path / "none.elf")
    assert "-L" in raised.value.hint
    with pytest.raises(InputError, match="missing"):
        compile_sketch(sketch, tmp_path / "none.elf", libraries=[tmp_path / "missing"])


def test_a_sketch_may_be_named_by_its_file(tmp_path: Path) -> None:
    firmware(COUNTER)  # skips the test where the tools are missing
    sketch = sketch_using(tmp_path, "Arduino.h", then="")
    command = [sys.executable, "-m", "bridges.serial.firmware", str(sketch / "lamp.ino"), "-o", str(tmp_path / "out")]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    assert done.stdout.startswith(f"{tmp_path / 'out' / 'lamp.elf'}: ")
