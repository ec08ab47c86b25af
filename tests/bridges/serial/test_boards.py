"""Boards that are not there, as a user has them."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from bridges.serial.boards import BoardFailed, NoFirmware, SimulatedBoard, simulator
from bridges.serial.firmware import SketchBroken, compile_sketch
from mesh.errors import ConfigurationError, InputError
from tests.support.boards import COUNTER, board, firmware
from tests.support.commands import AIRA, aira, environment

SECONDS = 60


def test_a_board_runs_from_the_command_line_until_it_is_told_to_end() -> None:
    command = [*map(str, AIRA), "board", "run", str(firmware(COUNTER))]
    with subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=environment({})
    ) as process:
        output, _ = process.communicate("adc 0 2500\nunplug\nplug\nreset\nquit\n", timeout=SECONDS)
    assert process.returncode == 0
    assert "use it with: aira edge /" in output


@pytest.mark.parametrize("line", ["help", "adc 8 100", "noise 2"])
def test_what_a_board_does_not_understand_is_said_with_what_it_does(line: str) -> None:
    command = [*map(str, AIRA), "board", "run", str(firmware(COUNTER))]
    with subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment({})
    ) as process:
        assert process.stdin is not None
        assert process.stderr is not None
        process.stdin.write(f"{line}\n")
        process.stdin.flush()
        assert process.stderr.readline().startswith(f"'{line}' is nothing a board understands; lines to type: adc")
        process.communicate("quit\n", timeout=SECONDS)
    assert process.returncode == 0


@pytest.mark.parametrize(
    ("content", "why"),
    [
        (b"no firmware", "it is no ELF file"),
        (b"", "it is no ELF file"),
        (Path(sys.executable).read_bytes()[:64], "it is for another processor"),
    ],
    ids=["text", "empty", "another processor"],
)
def test_firmware_that_is_none_is_one_clear_line(content: bytes, why: str, tmp_path: Path) -> None:
    nothing = tmp_path / "nothing.elf"
    nothing.write_bytes(content)
    done = aira("board", "run", nothing)
    assert done.returncode == 2
    first, hint = done.stderr.splitlines()
    assert first == f"aira: {nothing} is no firmware for an Uno: {why}"
    assert "bridges.serial.firmware" in hint


def test_a_file_that_is_not_there_is_no_firmware(tmp_path: Path) -> None:
    done = aira("board", "run", tmp_path / "none.elf")
    assert done.returncode == 2
    assert "does not exist" in done.stderr
    with pytest.raises(NoFirmware), SimulatedBoard(tmp_path):
        pass


def test_without_the_simulators_library_it_is_said_how_to_install_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("AIRA_PEERS_CACHE", str(tmp_path))
    monkeypatch.setattr("bridges.serial.boards.HEADER", tmp_path / "sim_avr.h")
    with pytest.raises(ConfigurationError, match="libsimavr") as raised:
        simulator()
    assert "libsimavr-dev" in raised.value.hint


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
