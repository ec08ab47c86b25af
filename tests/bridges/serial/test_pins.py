"""What a user does with a simulated board: buttons, dimmed lamps, the serial monitor, a port of one's own choice."""

from __future__ import annotations

import subprocess
from contextlib import contextmanager
from typing import TYPE_CHECKING

import pytest

from bridges.serial.boards import SimulatedBoard
from bridges.serial.dialect import BoardReady, LineError, MessageReceived
from bridges.serial.frames import FramesDialect
from bridges.serial.line import SerialPort
from tests.support.boards import COUNTER, DIMMER, TALKER, board, firmware
from tests.support.commands import AIRA, aira, environment
from tests.support.lines import LineClient
from tests.support.raising import raises_with

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

SECONDS = 60
LAMP, BUTTON = 9, 2


@contextmanager
def dimmer() -> Iterator[tuple[SimulatedBoard, LineClient]]:
    with board(DIMMER) as uno, LineClient(uno, FramesDialect(baud=57_600)) as client:
        yield uno, client


def test_a_button_is_pressed_and_released() -> None:
    with dimmer() as (uno, client):
        uno.set_pin(BUTTON, False)
        assert client.next(MessageReceived).payload == b"true"
        uno.set_pin(BUTTON, True)
        assert client.next(MessageReceived).payload == b"false"
        uno.set_pin(BUTTON, False)
        assert client.next(MessageReceived).payload == b"true"
        uno.set_pin(BUTTON, None)  # its pull-up lifts it
        assert client.next(MessageReceived).payload == b"false"
    assert [change.high for change in uno.changes(BUTTON)][-4:] == [False, True, False, True]


@pytest.mark.parametrize("level", [None, True, False])
def test_an_input_has_its_level_also_after_a_reset(level: bool | None) -> None:
    with dimmer() as (uno, client):
        uno.set_pin(BUTTON, level)
        uno.reset()
        client.next(BoardReady)
        pressed = level is False
        uno.set_pin(BUTTON, pressed)
        assert client.next(MessageReceived).payload == (b"false" if pressed else b"true")


def test_a_dimmed_lamp_is_one_change_not_a_thousand() -> None:
    with dimmer() as (uno, client):
        for level in (64, 128, 255, 3, 0):
            client.call("/dim", str(level).encode())
        uno.wait_until(lambda: uno.changes(LAMP) and not uno.changes(LAMP)[-1].high, what="the end")
    assert [(change.pin, change.value, change.top) for change in uno.dimmings] == [
        (LAMP, 64, 255),
        (LAMP, 128, 255),
        (LAMP, 3, 255),
    ]
    assert uno.dimmings[1].duty == pytest.approx(0.5, abs=0.01)
    levels = [change.high for change in uno.changes(LAMP)]
    assert levels[-2:] == [True, False]
    assert len(levels) < 6


def test_the_monitor_shows_text_and_sends_lines() -> None:
    with board(TALKER) as uno:
        uno.send("monitor on")
        uno.reset()
        uno.wait_until(lambda: "serial hello\\t\\x01" in uno.output, what="the greeting")
        uno.send("send how are you?")
        uno.wait_until(lambda: "serial heard how are you?" in uno.output, what="the answer")
        uno.send("monitor off")


def test_bytes_at_another_speed_are_garbage() -> None:
    with board(TALKER) as uno:
        uno.send("monitor on")
        for baud, heard in ((57_600, False), (9_600, True)):
            port = SerialPort(uno.port, baud=baud)
            uno.wait_until(lambda: "opened" in uno.output, what="the opening")
            uno.output.clear()
            port.write(b"are you there?\n")
            uno.wait_until(lambda: any("serial heard" in line for line in uno.output), what="its answer")
            assert ("serial heard are you there?" in uno.output) is heard
            port.close()
            uno.wait_until(lambda: "closed" in uno.output, what="the closing")


@contextmanager
def run_board(*options: str | Path) -> Iterator[subprocess.Popen[str]]:
    command = [*map(str, AIRA), "board", "run", *map(str, options)]
    with subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=environment({})
    ) as process:
        try:
            yield process
        finally:
            process.terminate()


def test_a_port_of_ones_own_choice_lasts_as_long_as_the_board(tmp_path: Path) -> None:
    port = tmp_path / "uno"
    for _ in range(2):
        with run_board(firmware(COUNTER), "--tty", port) as process:
            assert process.stdout is not None
            while not process.stdout.readline().startswith(f"connect it with: aira edge {port}"):
                pass
            assert port.is_symlink()
            assert port.is_char_device()
            second = aira("board", "run", firmware(COUNTER), "--tty", port)
            assert second.returncode == 1
            assert "[port-busy]" in second.stderr
            process.communicate("quit\n", timeout=SECONDS)
        assert not port.is_symlink()


def test_a_file_in_place_of_the_port_is_kept(tmp_path: Path) -> None:
    port = tmp_path / "notes"
    port.write_text("mine")
    with raises_with(LineError, code="invalid-port"), SimulatedBoard(firmware(COUNTER), port=port):
        pass
    assert port.read_text() == "mine"


def test_a_link_that_a_killed_board_has_left_is_replaced(tmp_path: Path) -> None:
    port = tmp_path / "uno"
    port.symlink_to(tmp_path / "gone")
    with SimulatedBoard(firmware(COUNTER), port=port) as uno:
        assert uno.port == port
        assert port.is_char_device()


def test_the_monitor_misses_nothing_of_what_a_board_says_first() -> None:
    with SimulatedBoard(firmware(TALKER), monitor=True) as uno:
        uno.wait_until(lambda: any(line.startswith("serial") for line in uno.output), what="the greeting")
        assert "serial hello\\t\\x01" in uno.output


def test_the_command_line_shows_text_dimming_and_levels() -> None:
    with run_board(firmware(TALKER), "--monitor") as process:
        assert process.stdin is not None
        assert process.stdout is not None
        shown = ["\n"]
        for command, until in (("pin 4 free", "hello"), ("pin 4 high", "pin  4"), ("send hi", "heard hi")):
            process.stdin.write(f"{command}\n")
            process.stdin.flush()
            while shown[-1] and until not in shown[-1]:
                shown.append(process.stdout.readline())
        process.communicate("quit\n", timeout=SECONDS)
    assert any(line.startswith("hello") for line in shown)
    assert any(line.split()[-3:] == ["pin", "4", "high"] for line in shown)
