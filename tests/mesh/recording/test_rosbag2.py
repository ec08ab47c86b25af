"""Recordings of rosbag2 as objectives: written and read by rosbags, and hostile ones."""

from __future__ import annotations

import sqlite3
from typing import TYPE_CHECKING

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from mesh.recording import (
    CorruptRecording,
    Limits,
    NotARecording,
    RecordingError,
    RecordingTooLarge,
    open_objective,
    preflight,
    recording_file,
)
from mesh.recording.ros_values import ros_value
from mesh.ros import RosTypes
from schemas.payloads import PayloadType
from tests.mesh.recording.files import SECOND, T0
from tests.support.rosbag2 import database, rosbag2

if TYPE_CHECKING:
    from pathlib import Path

    from tests.support.rosbag2 import Sent, Storage

ROS = RosTypes("jazzy")
HELLO = b"\x00\x01\x00\x00\x06\x00\x00\x00Hello\x00"


def drive(count: int) -> list[Sent]:
    twists = [
        ("/cmd_vel", T0 + n * SECOND, ROS.message("geometry_msgs/Twist", linear={"x": n / 4})) for n in range(count)
    ]
    return [*twists, ("/said", T0 + 5, ROS.message("std_msgs/String", data="go"))]


@pytest.mark.parametrize("storage", ["MCAP", "SQLITE3"])
def test_all_content_of_rosbag2_is_read(tmp_path: Path, storage: Storage) -> None:
    sent = drive(9)
    objective = open_objective(rosbag2(tmp_path / "it", sent, storage))

    assert objective.format == storage.lower()
    assert (objective.count, objective.start_ns, objective.duration_ns) == (10, T0, 8 * SECOND)
    played = [(one.topic, one.log_time_ns, one.payload, one.type) for one in objective.messages()]
    assert played == sorted([(topic, time, each.data, each.type) for topic, time, each in sent], key=lambda row: row[1])
    assert [one.payload for one in objective.messages(from_index=4)] == [row[2] for row in played[4:]]
    assert preflight(objective.path).ok


@pytest.mark.parametrize("storage", ["MCAP", "SQLITE3"])
def test_a_message_has_the_value_that_its_definition_says(tmp_path: Path, storage: Storage) -> None:
    objective = open_objective(rosbag2(tmp_path / "it", drive(2), storage))
    zero = {"x": 0.0, "y": 0.0, "z": 0.0}

    values = {one.log_time_ns: one.value for one in objective.messages()}

    assert values == {
        T0: {"linear": zero, "angular": zero},
        T0 + 5: "go",
        T0 + SECOND: {"linear": {"x": 0.25, "y": 0.0, "z": 0.0}, "angular": zero},
    }


def test_a_message_without_a_definition_is_bytes(tmp_path: Path) -> None:
    objective = open_objective(rosbag2(tmp_path / "it", drive(1), "SQLITE3", definitions=False))
    assert [one.value for one in objective.messages()] == [one.payload for one in objective.messages()]
    assert {topic.type.schema_data for topic in objective.topics} == {b""}


def test_large_and_many_messages_are_read_in_blocks(tmp_path: Path) -> None:
    rows = [(1, T0 + n * 7919 % 9973, bytes(700 * (n % 3)) + n.to_bytes(4, "little")) for n in range(9000)]
    objective = open_objective(database(tmp_path / "it.db3", rows=rows))
    assert [(one.log_time_ns, one.payload) for one in objective.messages()] == sorted(
        [(time, data) for _, time, data in rows], key=lambda row: row[0]
    )


def test_the_file_of_a_folder_is_found(tmp_path: Path) -> None:
    path = rosbag2(tmp_path / "it", drive(1), "SQLITE3")
    assert recording_file(tmp_path / "it") == path
    assert recording_file(path) == path
    assert recording_file(tmp_path) == tmp_path
    (tmp_path / "it" / "it_1.db3").write_bytes(path.read_bytes())
    with pytest.raises(NotARecording, match="aira objective convert"):
        recording_file(tmp_path / "it")


HOSTILE = {
    "a view instead of the messages": (
        ("ALTER TABLE messages RENAME TO other", "CREATE VIEW messages AS SELECT * FROM other"),
        CorruptRecording,
    ),
    "a view that never ends": (
        (
            "DROP TABLE messages",
            "CREATE VIEW messages AS WITH RECURSIVE n(id) AS (SELECT 1 UNION ALL SELECT id + 1 FROM n)"
            " SELECT id, 1 AS topic_id, id AS timestamp, x'00' AS data FROM n",
        ),
        CorruptRecording,
    ),
    "a column that is computed": (
        (
            "DROP TABLE messages",
            "CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER,"
            " data BLOB AS (zeroblob(900000000)))",
            "INSERT INTO messages(topic_id, timestamp) VALUES (1, 1)",
        ),
        CorruptRecording,
    ),
    "a virtual table": (
        ("DROP TABLE topics", "CREATE VIRTUAL TABLE topics USING fts5(id, name, type, serialization_format)"),
        CorruptRecording,
    ),
    "no tables": (("DROP TABLE topics",), NotARecording),
    "other columns": (("ALTER TABLE messages RENAME COLUMN data TO content",), CorruptRecording),
    "many tables": (tuple(f"CREATE TABLE t{n}(x)" for n in range(70)), NotARecording),
    "a long definition": ((f"CREATE TABLE t(x DEFAULT '{'x' * 20_000}')",), CorruptRecording),
    "a long row": (("INSERT INTO messages VALUES (7, 1, 1, zeroblob(40000))",), CorruptRecording),
    "rows that add up": (
        tuple(f"INSERT INTO messages VALUES ({n}, 1, 1, zeroblob(20000))" for n in range(7, 67)),
        RecordingTooLarge,
    ),
    "a text as time": (("INSERT INTO messages VALUES (7, 1, 'now', x'00')",), CorruptRecording),
    "no data": (("INSERT INTO messages VALUES (7, 1, 1, NULL)",), CorruptRecording),
    "a time before 1970": (("INSERT INTO messages VALUES (7, 1, -1, x'00')",), CorruptRecording),
    "an undefined topic": (("INSERT INTO messages VALUES (7, 9, 1, x'00')",), CorruptRecording),
    "a name that is no text": (("UPDATE topics SET name = NULL",), CorruptRecording),
    "a name that is not UTF-8": (("UPDATE topics SET name = x'ff'",), CorruptRecording),
    "many topics": (
        tuple(f"INSERT INTO topics VALUES ({n}, '/t{n}', 'a/msg/B', 'cdr')" for n in range(2, 40)),
        RecordingTooLarge,
    ),
    "a long type": (("UPDATE topics SET type = hex(zeroblob(10000))",), RecordingTooLarge),
    "compressed messages": (("INSERT INTO messages VALUES (7, 1, 1, x'28b52ffd00')",), NotARecording),
}
SMALL = Limits(size=4 << 20, expanded=1 << 20, record=32 << 10, window=1 << 20, definitions=16 << 10, channels=16)


@pytest.mark.parametrize("name", HOSTILE)
def test_a_hostile_database_is_refused(tmp_path: Path, name: str) -> None:
    statements, error = HOSTILE[name]
    path = database(tmp_path / "it.db3", rows=[(1, 1, HELLO)])
    assert open_objective(path, SMALL).count == 1
    before = path.read_bytes()
    with sqlite3.connect(path) as opened:
        for statement in statements:
            opened.execute(statement)
    opened.close()
    assert path.read_bytes() != before

    with pytest.raises(RecordingError) as refused:
        open_objective(path, SMALL)

    assert type(refused.value) is error


def test_nothing_is_written_beside_a_database_and_no_journal_is_read(tmp_path: Path) -> None:
    path = database(tmp_path / "it.db3", "PRAGMA journal_mode = WAL", rows=[(1, 1, HELLO)])
    (tmp_path / "it.db3-journal").write_bytes(b"\xd9\xd5\x05\xf9\x20\xa1\x63\xd7" + bytes(504))
    names = sorted(file.name for file in tmp_path.iterdir())
    content = path.read_bytes()
    assert [one.payload for one in open_objective(path).messages()] == [HELLO]
    assert sorted(file.name for file in tmp_path.iterdir()) == names
    assert path.read_bytes() == content


def test_triggers_and_indexes_of_a_stranger_are_not_used(tmp_path: Path) -> None:
    path = database(
        tmp_path / "it.db3",
        "CREATE TRIGGER t AFTER INSERT ON messages BEGIN DELETE FROM messages; END",
        "CREATE INDEX timestamp_idx ON messages(abs(timestamp))",
        rows=[(1, n, HELLO) for n in range(5)],
    )
    assert [one.log_time_ns for one in open_objective(path).messages()] == list(range(5))


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None, max_examples=150)
@given(
    rows=st.lists(
        st.tuples(
            st.one_of(st.none(), st.integers(-2, 3), st.text(max_size=3)),
            st.one_of(st.none(), st.integers(-(1 << 63), (1 << 63) - 1), st.floats(), st.text(max_size=3)),
            st.one_of(st.none(), st.binary(max_size=40), st.integers(-9, 9), st.text(max_size=5)),
        ),
        max_size=6,
    )
)
def test_rows_of_any_kind_are_read_or_refused(tmp_path: Path, rows: list[tuple[object, ...]]) -> None:
    path = tmp_path / "any.db3"
    path.unlink(missing_ok=True)
    database(path, rows=rows)
    try:
        read = [(1, one.log_time_ns, one.payload) for one in open_objective(path).messages()]
    except RecordingError:
        return
    stored = [(topic, time, data.encode() if isinstance(data, str) else data) for topic, time, data in rows]
    assert sorted(read) == sorted(stored)


@pytest.mark.parametrize(
    ("name", "definition"),
    [
        ("a/msg/B:\n    x=print()\nclass C", "int32 y\n"),
        ("a/msg/B", f"int32 y\n{'=' * 80}\nMSG: a/C:\n    x=print()\nint32 z\n"),
        ("a/msg/B", "B b\n"),
        ("a/msg/B", "int32 y\n" * 5000),
        ("a/msg/B", "$"),
        ("", "int32 y\n"),
        ("a/msg/B", f"C[2] c\n{'=' * 80}\nMSG: a/C\nB[2] b\n"),
    ],
)
def test_a_stranger_s_definition_harms_nothing(capsys: pytest.CaptureFixture[str], name: str, definition: str) -> None:
    payload = b"\0\1\0\0" + bytes(60)
    assert ros_value(payload, PayloadType("cdr", name, "ros2msg", definition.encode())) == payload
    assert capsys.readouterr().out == ""


@settings(deadline=None, max_examples=300)
@given(
    st.binary(max_size=80), st.sampled_from(["sensor_msgs/Image", "std_msgs/Float64MultiArray", "tf2_msgs/TFMessage"])
)
def test_any_payload_of_a_type_has_a_value(payload: bytes, name: str) -> None:
    kind = ROS.message(name).type
    assert ros_value(payload, kind) == payload or isinstance(ros_value(payload, kind), dict)
