"""The firmware libraries on a simulated Uno, over clean and noisy lines; and sketches that use Arduino libraries."""

from __future__ import annotations

import json
import logging
import re
import select
import subprocess
import sys
import time
from pathlib import Path

import pytest

from bridges.serial.boards import SimulatedBoard
from bridges.serial.dialect import (
    BoardLogged,
    BoardLost,
    BoardReady,
    CallStatus,
    CommandFinished,
    Flow,
    LineCounters,
    MessageReceived,
)
from bridges.serial.firmware import compile_sketch, size_of
from bridges.serial.frames import Frame, FrameDecoder, FrameKind, FramesDialect, encode_frame
from bridges.serial.line import SerialPort
from bridges.serial.rosserial import RosserialDialect
from mesh.errors import InputError
from schemas.payloads import String
from tests.support.boards import COUNTER, DIMMER, ECHO, ROSSERIAL_ECHO, board, firmware
from tests.support.lines import LineClient
from tests.support.raising import raises_with

BAUD = 57_600
FLASH, RAM = 3000, 500
"""The most bytes that an echo may use of an Uno."""


def frames(uno: SimulatedBoard) -> LineClient:
    return LineClient(uno, FramesDialect(baud=BAUD, session=1234))


def rosserial(uno: SimulatedBoard) -> LineClient:
    return LineClient(uno, RosserialDialect(baud=BAUD, parameters={"loud": 7}))


def test_an_echo_uses_little_of_an_uno() -> None:
    flash, ram = size_of(firmware(ECHO))
    assert flash <= FLASH
    assert ram <= RAM


def test_text_that_a_sketch_prints_between_frames_does_no_harm() -> None:
    with board(DIMMER, "CHATTY") as uno, frames(uno) as client:
        assert client.call("/dim", b"64").status is CallStatus.DONE
        assert client.dialect.counters.damaged > 0  # the text


@pytest.mark.full
def test_a_thousand_calls_are_done_once_each_over_a_line_that_damages_one_byte_in_a_hundred() -> None:
    with board(COUNTER) as uno, frames(uno) as client:
        uno.add_noise(0.01, seed=3)
        for number in range(1, 1001):
            ended = client.call("/add", b"1")
            assert (ended.status, ended.payload) == (CallStatus.DONE, str(number).encode())
        assert client.dialect.counters.damaged > 0
        assert client.dialect.counters.repeated > 0


def test_values_of_all_types_cross_both_ways() -> None:
    with board(COUNTER) as uno, frames(uno) as client:
        for given in (b'[-70000,-1.5,true,"abc"]', b'[200,0.25,false,""]', b'[-5,1e+30,true,"0123456789"]'):
            ended = client.call("/values", given)
            assert ended.status is CallStatus.DONE
            integer, real, *rest = _json(given)
            returned = _json(ended.payload)
            assert [returned[0], *returned[2:]] == [integer, *rest]
            assert returned[1] == pytest.approx(real)
        refused = client.call("/values", b'[1,2,3,"x"]')
        assert (refused.reason, refused.detail) == ("refused", "[integer, real, boolean, text] is wanted")


def test_a_long_call_is_done_once_and_publishes_one_event() -> None:
    with board(COUNTER) as uno, frames(uno) as client:
        assert client.call("/slow", b"5").payload == b"5"
        assert client.call("/sum").payload == b"5"
        assert [each.payload for each in client.events if isinstance(each, MessageReceived)] == [b"5"]


def test_a_call_during_which_the_board_reads_nothing_is_done_once_and_so_is_the_next() -> None:
    with board(COUNTER) as uno, frames(uno) as client:
        assert client.call("/block", b"5").payload == b"5"
        assert client.dialect.counters.repeated > 0
        assert client.call("/add", b"1").payload == b"6"


def test_a_board_that_keeps_running_while_unplugged_finishes_the_call_once() -> None:
    with board(COUNTER) as uno, frames(uno) as client:
        sent = client.submit("/slow", b"5")
        client.next(MessageReceived)
        uno.unplug()
        client.next(BoardLost)
        uno.plug()
        ended = client.ended(sent)  # on a busy machine perhaps before the cable was pulled
        assert (ended.status, ended.payload) == (CallStatus.DONE, b"5")
        assert client.call("/sum").payload == b"5"


def test_a_call_during_which_the_board_is_reset_is_in_doubt_and_later_ones_are_done() -> None:
    with board(COUNTER) as uno, frames(uno) as client:
        client.submit("/slow", b"5")
        client.submit("/add", b"2")
        client.next(MessageReceived)
        uno.reset()
        assert client.next(CommandFinished).reason == "doubt"
        ended = client.next(CommandFinished)
        assert (ended.status, ended.payload) == (CallStatus.DONE, b"2")


def test_a_board_without_a_session_accepts_no_call() -> None:
    line = FrameDecoder(LineCounters())
    with board(COUNTER) as uno:
        port = SerialPort(uno.port, baud=BAUD)
        uno.wait_until(lambda: "opened" in uno.output, what="the opening")
        port.write(b"\0" + encode_frame(Frame(FrameKind.CALL, 1, 0, b"\x05")))
        received: list[Frame] = []
        while not any(frame.sequence == 1 for frame in received):
            assert select.select([port], [], [], 30)[0]
            received += line.feed(port.read())
        port.close()
        assert received[-1].kind is FrameKind.BOARD
        with frames(uno) as client:
            assert client.call("/sum").payload == b"0"


def test_a_board_that_resets_when_opened_is_found() -> None:
    with SimulatedBoard(firmware(COUNTER), resets=True) as uno, frames(uno) as client:
        assert client.call("/add", b"1").payload == b"1"


def flashes(uno: SimulatedBoard) -> list[bool]:
    """The levels of the lamp since it was first lit."""
    levels = [change.high for change in uno.changes(13)]
    return levels[levels.index(True) :] if True in levels else []


def test_rosserial_commands_are_queued_and_all_of_them_run() -> None:
    # On a busy machine the board runs slower than its line: allow it more time to announce its topics.
    patient = RosserialDialect(baud=BAUD, settle_time=8.0)
    with board(ROSSERIAL_ECHO) as uno, LineClient(uno, patient) as client:
        for _ in range(12):
            client.submit("/work", seconds=200)
        assert [client.next(CommandFinished).status for _ in range(12)] == [CallStatus.READ] * 12
        uno.wait_until(lambda: flashes(uno) == [True, False] * 12, what="twelve flashes")


def test_rosserial_services_parameters_and_logs_work() -> None:
    with board(ROSSERIAL_ECHO) as uno, rosserial(uno) as client:
        assert client.call("/twice").status is CallStatus.DONE
        client.submit("/ask")
        assert client.next(MessageReceived).payload == String("loud").encode()
        assert client.next(BoardLogged).text == "asked"


def test_a_request_of_a_rosserial_board_is_answered() -> None:
    with board(ROSSERIAL_ECHO) as uno, rosserial(uno) as client:
        client.submit("/inquire")
        asked = client.next(MessageReceived)
        assert (asked.topic.name, asked.topic.flow, asked.payload) == (
            "/weather",
            Flow.REQUESTS,
            String("how is it?").encode(),
        )
        answer = String("it rains").encode()
        client.line.call_soon(lambda: client.dialect.respond(asked.topic, answer, time.monotonic()))
        assert client.next(MessageReceived).payload == answer


def test_messages_on_unannounced_ids_are_counted_and_garbled_logs_are_text() -> None:
    with board(ROSSERIAL_ECHO) as uno, rosserial(uno) as client:
        client.submit("/garble")
        logged = client.next(BoardLogged)
        assert (logged.level, logged.text) == (logging.ERROR, "\ufffd(hot\ufffd")
        assert client.dialect.counters.stray == 1
        assert client.call("/hear", String("still here").encode()).status is CallStatus.READ


def test_a_message_on_an_unannounced_topic_never_reaches_a_rosserial_board() -> None:
    with board(ROSSERIAL_ECHO) as uno, rosserial(uno) as client:
        refused = client.call("/unknown", b"")
        assert (refused.status, refused.reason) == (CallStatus.FAILED, "unfit")
        assert client.call("/hear", String("still here").encode()).status is CallStatus.READ


def test_the_longest_string_reaches_a_rosserial_board() -> None:
    with board(ROSSERIAL_ECHO) as uno, rosserial(uno) as client:
        longest = String("x" * 111).encode()
        client.submit("/hear", longest)
        assert client.next(MessageReceived).payload == longest
        assert client.call("/hear", String("x" * 112).encode()).reason == "unfit"


def test_a_rosserial_board_that_was_reset_is_found_again() -> None:
    with board(ROSSERIAL_ECHO) as uno, rosserial(uno) as client:
        uno.unplug()
        client.next(BoardLost)
        uno.reset()
        uno.plug()
        client.next(BoardReady)
        assert client.call("/hear", String("again").encode()).status is CallStatus.READ


@pytest.mark.full
def test_a_damaged_message_of_a_rosserial_board_is_never_accepted() -> None:
    with board(ROSSERIAL_ECHO) as uno, rosserial(uno) as client:
        uno.add_noise(0.003, seed=5)
        texts = [String(f"message {number:03}").encode() for number in range(100)]
        for text in texts:
            client.submit("/hear", text, seconds=20.0)  # what is damaged delays the others: few are done by then
        for _ in texts:
            client.next(CommandFinished)
        said = [each.payload for each in client.events if isinstance(each, MessageReceived)]
        assert set(said) <= set(texts)
        assert len(said) > 10
        assert client.dialect.counters.damaged > 0


def _json(data: bytes) -> list[object]:
    values: list[object] = json.loads(data)
    return values


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
    with raises_with(InputError, match=r"Nowhere\.h", code="compilation-failed") as raised:
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


FIRMWARE = Path(__file__).parents[3] / "examples" / "firmware"


def test_the_readme_lists_every_call_of_the_library() -> None:
    keywords = (FIRMWARE / "AiraFrames" / "keywords.txt").read_text().splitlines()
    calls = {line.split("\t")[0] for line in keywords if line.endswith("KEYWORD2")}
    listed = (FIRMWARE / "README.md").read_text().split("### Calls")[1].split("\n## ")[0]
    source = (FIRMWARE / "AiraFrames" / "src" / "AiraFrames.h").read_text()
    assert calls
    for call in calls:
        assert re.search(rf"`{call}\b", listed), call
        assert re.search(rf"\b{call}\b", source), call
