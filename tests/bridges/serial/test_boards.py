"""Boards that are not there, as a user has them."""

from __future__ import annotations

import subprocess
from typing import TYPE_CHECKING

import pytest

from bridges.serial.boards import BoardFailed
from bridges.serial.firmware import SketchBroken, compile_sketch
from mesh.errors import InputError
from tests.support.boards import COUNTER, board, firmware
from tests.support.commands import AIRA, aira, environment

if TYPE_CHECKING:
    from pathlib import Path

SECONDS = 60


def test_a_board_runs_from_the_command_line_until_it_is_told_to_end() -> None:
    command = [*map(str, AIRA), "board", "run", str(firmware(COUNTER))]
    with subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=environment({})
    ) as process:
        output, _ = process.communicate("adc 0 2500\nunplug\nplug\nreset\nquit\n", timeout=SECONDS)
    assert process.returncode == 0
    assert "use it with: aira edge /" in output


def test_firmware_that_is_none_is_one_clear_line(tmp_path: Path) -> None:
    firmware(COUNTER)  # skips where the tools are missing
    nothing = tmp_path / "nothing.elf"
    nothing.write_bytes(b"no firmware")
    done = aira("board", "run", nothing)
    assert done.returncode == 1
    assert "Traceback" not in done.stderr


def test_the_port_keeps_its_name_when_the_cable_is_pulled() -> None:
    with board(COUNTER) as uno:
        before = uno.port.resolve()
        uno.unplug()
        assert not uno.port.exists()
        uno.plug()
        assert uno.port.exists()
        assert before.parent == uno.port.resolve().parent
    assert not uno.port.exists()


def test_a_board_that_has_ended_can_not_be_used() -> None:
    uno = board(COUNTER)
    with pytest.raises(BoardFailed):
        uno.reset()


def test_a_sketch_that_does_not_compile_says_where(tmp_path: Path) -> None:
    firmware(COUNTER)
    sketch = tmp_path / "broken"
    sketch.mkdir()
    (sketch / "broken.ino").write_text("void setup() {\n  int x = ;\n}\nvoid loop() {}\n")
    with pytest.raises(SketchBroken, match=r"broken\.ino.*2:"):
        compile_sketch(sketch, tmp_path / "broken.elf")
    with pytest.raises(InputError):
        compile_sketch(tmp_path, tmp_path / "none.elf")


def test_functions_may_be_used_before_they_are_defined(tmp_path: Path) -> None:
    firmware(COUNTER)
    sketch = tmp_path / "forward"
    sketch.mkdir()
    (sketch / "forward.ino").write_text("void setup() { later(1); }\nvoid loop() {}\nint later(int x) { return x; }\n")
    assert compile_sketch(sketch, tmp_path / "forward.elf").exists()
