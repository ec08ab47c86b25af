"""Dialects: which are installed, and how an edge agent finds that of a board, and its baud rate."""

from __future__ import annotations

import threading
import time
from typing import TYPE_CHECKING

import pytest

from bridges.serial._device import Device
from bridges.serial.boards import SimulatedBoard
from bridges.serial.dialect import (
    BAUDS,
    COMMAND_LIMITS,
    DETECTED,
    BoardLost,
    BoardReady,
    CallStatus,
    Command,
    CommandFinished,
    CommandRefused,
    DetectingDialect,
    Dialect,
    dialect_names,
    load_dialect,
    make_dialect,
)
from bridges.serial.frames import FramesDialect
from bridges.serial.rosserial import RosserialDialect
from mesh.errors import ConfigurationError, InputError
from schemas.payloads import String
from tests.support.boards import COUNTER, ROSSERIAL_ECHO, TALKER, board, edge, firmware
from tests.support.lines import LineClient
from tests.support.raising import raises_with
from tests.support.waiting import until

if TYPE_CHECKING:
    from pathlib import Path

    from tests.support.market import Place


def test_the_dialects_of_this_package_are_installed() -> None:
    assert {"frames", "rosserial"} <= set(dialect_names())
    for name in dialect_names():
        dialect = load_dialect(name)(baud=57_600, parameters={"rate": 7})
        assert isinstance(dialect, Dialect)
        assert dialect.info is None


def test_an_unknown_dialect_is_refused_with_those_that_are_installed() -> None:
    with raises_with(InputError, code="unknown-dialect") as caught:
        load_dialect("morse")
    assert str(caught.value).startswith("there is no dialect 'morse'; installed: ")
    assert all(name in str(caught.value) for name in ("frames", "rosserial"))


def test_an_installed_package_adds_a_dialect(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    about = tmp_path / "morse-1.0.dist-info"
    about.mkdir()
    (about / "entry_points.txt").write_text(
        "[aira.dialects]\nmorse = bridges.serial.frames:FramesDialect\nodd = os:no_such_dialect\n"
    )
    monkeypatch.syspath_prepend(str(tmp_path))
    assert "morse" in dialect_names()
    assert load_dialect("morse").__name__ == "FramesDialect"
    with raises_with(ConfigurationError, code="dialect-broken") as caught:
        load_dialect("odd")
    assert caught.value.hint == "reinstall or uninstall morse"


LONG = 60.0
SECOND = 115_200
CALLS = {COUNTER: ("/add", b"5"), ROSSERIAL_ECHO: ("/hear", String("hello").encode())}


def speed(baud: int) -> tuple[str, ...]:
    return (f"BAUD={baud}",)


@pytest.mark.sample("sketch", "protocol", "baud")
@pytest.mark.parametrize(
    ("sketch", "protocol", "baud"),
    [
        (COUNTER, "frames", 57_600),
        (COUNTER, "frames", 9_600),
        (COUNTER, "frames", SECOND),
        (ROSSERIAL_ECHO, "rosserial", 57_600),
        (ROSSERIAL_ECHO, "rosserial", SECOND),
        (ROSSERIAL_ECHO, "rosserial", 9_600),
        (COUNTER, "frames", 500_000),
    ],
)
def test_protocol_and_baud_rate_are_found(sketch: str, protocol: str, baud: int) -> None:
    topic, payload = CALLS[sketch]
    with board(sketch, *speed(baud)) as uno, LineClient(uno, make_dialect("auto", 0)) as client:
        assert (client.dialect.protocol, client.dialect.baud) == (protocol, baud)
        assert client.call(topic, payload).status is not CallStatus.FAILED


def test_a_known_protocol_is_found_at_its_baud_rate_and_the_other_way_round() -> None:
    with board(ROSSERIAL_ECHO, *speed(SECOND)) as uno:
        for protocol, baud in (("rosserial", 0), ("auto", SECOND)):
            with LineClient(uno, make_dialect(protocol, baud)) as client:
                assert (client.dialect.protocol, client.dialect.baud) == ("rosserial", SECOND)


def test_nothing_is_searched_for_what_is_stated() -> None:
    assert type(make_dialect("frames", 9_600)) is FramesDialect
    assert type(make_dialect("rosserial", SECOND)) is RosserialDialect
    with raises_with(InputError, code="unknown-dialect"):
        make_dialect("morse", 0)


def test_a_board_that_resets_when_its_port_is_opened_is_found() -> None:
    uno = SimulatedBoard(firmware(ROSSERIAL_ECHO, *speed(SECOND)), resets=True)
    with uno, LineClient(uno, make_dialect("auto", 0)) as client:
        assert (client.dialect.protocol, client.dialect.baud) == ("rosserial", SECOND)


def test_a_found_board_resumes_its_call_after_an_unplugged_cable() -> None:
    with board(COUNTER, *speed(SECOND)) as uno, LineClient(uno, make_dialect("auto", 0)) as client:
        sent = client.submit("/slow", b"5")
        uno.wait_until(lambda: uno.changes(13), what="the call")
        uno.unplug()
        client.next(BoardLost)
        uno.plug()
        assert client.ended(sent).payload == b"5"  # on a busy machine perhaps before the cable was pulled
        assert client.call("/sum").payload == b"5"


def test_a_board_with_another_protocol_at_the_same_port_is_found(tmp_path: Path) -> None:
    port = tmp_path / "uno"
    dialect = DetectingDialect(DETECTED, BAUDS, seconds_to_search_again=1.0)
    with SimulatedBoard(firmware(COUNTER), port=port) as uno, LineClient(uno, dialect) as client:
        assert client.call("/add", b"5").payload == b"5"
        uno.__exit__(None, None, None)
        client.next(BoardLost)
        with SimulatedBoard(firmware(ROSSERIAL_ECHO, *speed(SECOND)), port=port):
            client.next(BoardReady)
            assert (dialect.protocol, dialect.baud) == ("rosserial", SECOND)
            assert client.call("/hear", String("hello").encode()).status is CallStatus.READ


def test_what_was_submitted_during_the_search_is_done_when_the_board_is_found() -> None:
    dialect = make_dialect("auto", 0)
    dialect.submit(sent := Command("/add", b"5", time.monotonic() + LONG), time.monotonic())
    dialect.submit(unfit := Command("/nothing", b"", time.monotonic() + LONG), time.monotonic())
    with board(COUNTER, *speed(SECOND)) as uno, LineClient(uno, dialect) as client:
        ended = {each.command: each for each in (client.next(CommandFinished) for _ in range(2))}
    assert (ended[sent].status, ended[sent].payload) == (CallStatus.DONE, b"5")
    assert (ended[unfit].status, ended[unfit].reason) == (CallStatus.FAILED, "unfit")


def test_what_waits_during_the_search_is_bounded_in_time_and_number() -> None:
    dialect = make_dialect("auto", 0)
    dialect.opened(0.0)
    dialect.submit(late := Command("/add", b"5", deadline=1.0), 0.0)
    for _ in range(COMMAND_LIMITS.waiting - 1):
        dialect.submit(Command("/add", b"5"), 0.0)
    with raises_with(CommandRefused, code="board-busy"):
        dialect.submit(Command("/add", b"5"), 0.0)
    dialect.tick(1.0)
    [ended] = dialect.events()
    assert isinstance(ended, CommandFinished)
    assert (ended.command, ended.reason) == (late, "expired")


def test_every_speed_is_tried_in_each_round() -> None:
    dialect, now = make_dialect("auto", 0), 0.0
    seen: list[int] = []
    dialect.opened(now)
    while len(seen) < 2 * len(BAUDS):
        if not seen or seen[-1] != dialect.baud:
            seen.append(dialect.baud)
        assert now <= dialect.next_tick
        now = dialect.next_tick
        dialect.tick(now)
        assert len(dialect.outgoing()) < 64
    assert seen == [*BAUDS, *BAUDS]


async def test_an_edge_agent_needs_only_a_port_and_an_agent(place: Place) -> None:
    with (
        board(ROSSERIAL_ECHO, *speed(SECOND)) as uno,
        edge(uno.port, place.address("robot"), place.endpoint) as process,
    ):
        async with place.agent("robot") as robot:
            reply = await Device(robot, patience=LONG).call("/hear", String("hello"))
        assert reply.status is CallStatus.READ
        assert f"speaks rosserial at {SECOND} baud" in process.log()


async def test_a_board_that_speaks_no_known_protocol_is_reported_with_what_was_tried(place: Place) -> None:
    with board(TALKER) as uno, edge(uno.port, place.address("robot"), place.endpoint) as process:
        await until(lambda: "no board answers on" in process.log(), what="the warning", seconds=LONG)
        assert "115200" in process.log()
        assert process.log().count("no board answers on") == 1


def test_a_line_ends_at_once_during_the_search() -> None:
    with board(TALKER) as uno:
        client = LineClient(uno, make_dialect("auto", 0))
        thread = threading.Thread(target=client.line.run)
        thread.start()
        uno.wait_until(lambda: "opened" in uno.output, what="the opening")
        client.line.stop()
        thread.join(LONG)
        assert not thread.is_alive()
