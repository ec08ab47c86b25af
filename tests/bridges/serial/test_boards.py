"""Simulated boards and the compiler for their firmware."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from bridges.serial.boards import SimulatedBoard, simulator
from bridges.serial.firmware import compile_sketch
from mesh.errors import ConfigurationError, InputError, RemoteError
from tests.support.boards import COUNTER, board, firmware
from tests.support.commands import AIRA, aira, environment
from tests.support.raising import raises_with

SECONDS = 60


def test_a_board_runs_from_the_command_line_until_quit() -> None:
    command = [*map(str, AIRA), "board", "run", str(firmware(COUNTER))]
    with subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=environment({})
    ) as process:
        output, _ = process.communicate("adc 0 2500\nunplug\nplug\nreset\nquit\n", timeout=SECONDS)
    assert process.returncode == 0
    assert "connect it with: aira edge /" in output


def test_a_line_that_is_no_command_is_reported_and_the_board_keeps_running() -> None:
    command = [*map(str, AIRA), "board", "run", str(firmware(COUNTER))]
    with subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment({})
    ) as process:
        assert process.stdin is not None
        assert process.stderr is not None
        for line in ("help", "adc 8 100", "noise 2"):
            process.stdin.write(f"{line}\n")
            process.stdin.flush()
            reported = process.stderr.readline()
            if f"'{line}'" not in reported:
                process.kill()  # otherwise leaving `with` would wait for it
            assert f"'{line}'" in reported
            assert "adc 0-7 MILLIVOLTS" in reported
        process.communicate("quit\n", timeout=SECONDS)
    assert process.returncode == 0


@pytest.mark.parametrize(
    ("content", "why"),
    [
        (b"no firmware", "not an ELF file"),
        (b"", "not an ELF file"),
        (Path(sys.executable).read_bytes()[:64], "another processor"),
    ],
    ids=["text", "empty", "another processor"],
)
def test_a_file_that_is_not_firmware_is_one_clear_line(content: bytes, why: str, tmp_path: Path) -> None:
    nothing = tmp_path / "nothing.elf"
    nothing.write_bytes(content)
    done = aira("board", "run", nothing)
    assert done.returncode == 2
    first, hint = done.stderr.splitlines()
    assert str(nothing) in first
    assert why in first
    assert "[invalid-firmware]" in first
    assert "bridges.serial.firmware" in hint


def test_a_missing_file_is_not_firmware(tmp_path: Path) -> None:
    done = aira("board", "run", tmp_path / "none.elf")
    assert done.returncode == 2
    assert "does not exist" in done.stderr
    with raises_with(InputError, code="invalid-firmware"), SimulatedBoard(tmp_path):
        pass


def test_without_the_simulators_library_the_hint_says_how_to_install_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("AIRA_PEERS_CACHE", str(tmp_path))
    with pytest.raises(ConfigurationError) as raised:
        simulator(header=tmp_path / "sim_avr.h")
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


def test_a_board_that_is_not_running_can_not_be_used() -> None:
    uno = board(COUNTER)
    with raises_with(RemoteError, code="board-failed"):
        uno.reset()


def test_a_compilation_error_has_file_and_line(tmp_path: Path) -> None:
    firmware(COUNTER)
    sketch = tmp_path / "broken"
    sketch.mkdir()
    (sketch / "broken.ino").write_text("void setup() {\n  int x = ;\n}\nvoid loop() {}\n")
    with raises_with(InputError, match=r"broken\.ino.*2:", code="compilation-failed"):
        compile_sketch(sketch, tmp_path / "broken.elf")
    with pytest.raises(InputError):
        compile_sketch(tmp_path, tmp_path / "none.elf")


def test_functions_may_be_used_before_they_are_defined(tmp_path: Path) -> None:
    firmware(COUNTER)
    sketch = tmp_path / "forward"
    sketch.mkdir()
    (sketch / "forward.ino").write_text("void setup() { later(1); }\nvoid loop() {}\nint later(int x) { return x; }\n")
    assert compile_sketch(sketch, tmp_path / "forward.elf").exists()
