"""Recordings of rosbag2 as objectives, written and read by rosbags, and hostile ones; and our bags played by ROS 1."""

from __future__ import annotations

import os
import shutil
import socket
import sqlite3
import subprocess
from contextlib import ExitStack, closing
from typing import TYPE_CHECKING, Final

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from mesh.recording import (
    CorruptRecording,
    Limits,
    NotARecording,
    RecordingError,
    convert,
    open_objective,
    pack,
    preflight,
    recording_file,
)
from mesh.recording.objective import Played
from mesh.recording.ros import RosTypes, ros_value
from schemas.payloads import PayloadType
from tests.support.peers import require
from tests.support.ports import free_port
from tests.support.processes import Server
from tests.support.recording.files import SECOND, T0
from tests.support.rosbag2 import database, rosbag2

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
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
        RecordingError,
    ),
    "a text as time": (("INSERT INTO messages VALUES (7, 1, 'now', x'00')",), CorruptRecording),
    "no data": (("INSERT INTO messages VALUES (7, 1, 1, NULL)",), CorruptRecording),
    "a time before 1970": (("INSERT INTO messages VALUES (7, 1, -1, x'00')",), CorruptRecording),
    "an undefined topic": (("INSERT INTO messages VALUES (7, 9, 1, x'00')",), CorruptRecording),
    "a name that is no text": (("UPDATE topics SET name = NULL",), CorruptRecording),
    "a name that is not UTF-8": (("UPDATE topics SET name = x'ff'",), CorruptRecording),
    "many topics": (
        tuple(f"INSERT INTO topics VALUES ({n}, '/t{n}', 'a/msg/B', 'cdr')" for n in range(2, 40)),
        RecordingError,
    ),
    "a long type": (("UPDATE topics SET type = hex(zeroblob(10000))",), RecordingError),
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


LEFT_BY_A_CRASH: dict[str, tuple[str, tuple[str, ...], int | str]] = {
    "a transaction that is only in the log": ("WAL", ("BEGIN", "ADD", "COMMIT"), "it.db3-wal"),
    "a log that was merged": ("WAL", ("BEGIN", "ADD", "COMMIT", "MERGE"), 15),
    "a merged log, and the beginning of a transaction": (
        "WAL",
        ("BEGIN", "ADD", "COMMIT", "MERGE", "BEGIN", "ADD"),
        15,
    ),
    "the beginning of a transaction in the log": ("WAL", ("BEGIN", "ADD"), 0),
    "a merged transaction and one in the log": (
        "WAL",
        ("BEGIN", "ADD", "COMMIT", "MERGE", "BEGIN", "ADD", "COMMIT"),
        "it.db3-wal",
    ),
    "a transaction that is to be taken back": ("DELETE", ("BEGIN", "ADD"), "it.db3-journal"),
    "a journal without content": ("TRUNCATE", ("BEGIN", "ADD", "COMMIT"), 15),
    "a journal that was reset": ("PERSIST", ("BEGIN", "ADD", "COMMIT"), 15),
}


@pytest.mark.parametrize("name", LEFT_BY_A_CRASH)
def test_a_database_is_read_unless_a_journal_has_what_it_lacks(tmp_path: Path, name: str) -> None:
    mode, steps, expected = LEFT_BY_A_CRASH[name]
    path = database(tmp_path / "it.db3")
    killed = tmp_path / "killed"
    with closing(sqlite3.connect(path, isolation_level=None)) as opened:
        opened.executescript(f"PRAGMA journal_mode = {mode}; PRAGMA wal_autocheckpoint = 0; PRAGMA cache_size = 1")
        for step in steps:
            match step:
                case "ADD":
                    rows = [(1, time, bytes(9000)) for time in range(15)]
                    opened.executemany("INSERT INTO messages(topic_id, timestamp, data) VALUES (?, ?, ?)", rows)
                case "MERGE":
                    opened.execute("PRAGMA wal_checkpoint(PASSIVE)")
                case statement:
                    opened.execute(statement)
        shutil.copytree(tmp_path, killed, ignore=shutil.ignore_patterns("*-shm", "killed"))
    before = {file.name: file.read_bytes() for file in killed.iterdir()}
    assert len(before) == 2

    if isinstance(expected, int):
        assert open_objective(killed / "it.db3").count == expected
    else:
        with pytest.raises(NotARecording, match=expected):
            open_objective(killed / "it.db3")

    assert {file.name: file.read_bytes() for file in killed.iterdir()} == before


@pytest.mark.parametrize("suffix", ["-wal", "-journal"])
@pytest.mark.parametrize("content", [b"", bytes(512), b"no journal of SQLite at all"])
def test_a_journal_without_content_is_harmless(tmp_path: Path, suffix: str, content: bytes) -> None:
    path = database(tmp_path / "it.db3", rows=[(1, 1, HELLO)])
    path.with_name(f"it.db3{suffix}").write_bytes(content)
    assert [one.payload for one in open_objective(path).messages()] == [HELLO]


def test_a_folder_of_compressed_files_says_how_to_decompress_them(tmp_path: Path) -> None:
    (tmp_path / "metadata.yaml").write_text("")
    (tmp_path / "bag_0.db3.zstd").write_bytes(b"")
    with pytest.raises(NotARecording, match=r"zstd -d bag_0\.db3\.zstd"):
        recording_file(tmp_path)


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


PYTHON: Final = "/usr/bin/python3"
"""The only one that has Debian's ROS."""
SECONDS: Final = 60
TYPES = RosTypes("jazzy")
SENT: Final = {
    "/said": TYPES.message("std_msgs/String", data="go"),
    "/number": TYPES.message("std_msgs/Float64", data=2.5),
    "/led": TYPES.message("std_msgs/Empty"),
}
SHOWN: Final = {"/said": 'data: "go"\n---\n', "/number": "data: 2.5\n---\n", "/led": "\n---\n"}


class RosMaster(Server):
    """The master of ROS 1, without the logger that `roscore` starts."""

    name = "rosmaster"

    def __init__(self) -> None:
        super().__init__()
        self.port = free_port()

    @property
    def environment(self) -> Mapping[str, str]:
        """What nodes find in their environment."""
        return {
            "PATH": "/usr/bin:/bin",
            "ROS_MASTER_URI": f"http://127.0.0.1:{self.port}",
            "ROS_IP": "127.0.0.1",
            "ROS_HOME": str(self.folder),
            "ROS_LOG_DIR": str(self.folder),
        }

    def command(self) -> Sequence[str | Path]:
        variables = [f"{name}={value}" for name, value in self.environment.items()]
        return ["/usr/bin/env", *variables, PYTHON, require("rosmaster"), "--core", "-p", str(self.port)]

    def is_ready(self) -> bool:
        with socket.socket() as probe:
            return probe.connect_ex(("127.0.0.1", self.port)) == 0


def bag(folder: Path, times: Sequence[int]) -> Path:
    """A bag with a message on each topic at each of these times, converted from MCAP."""
    sent = [Played(topic, each.data, time, time, 0, each.type) for time in times for topic, each in SENT.items()]
    pack(sent, folder / "in.mcap")
    return convert(folder / "in.mcap", folder / "out.bag", to="bag").path


def run(*command: str | Path, environment: Mapping[str, str] | None = None) -> str:
    """What a program of ROS prints."""
    done = subprocess.run(
        [PYTHON, *command],
        env=dict(environment or {"PATH": "/usr/bin:/bin", "HOME": os.environ["HOME"]}),
        capture_output=True,
        text=True,
        timeout=SECONDS,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def test_rosbag_describes_our_bags(tmp_path: Path) -> None:
    rosbag, path = require("rosbag"), bag(tmp_path, [0, 10**9])
    said = run(rosbag, "info", "--yaml", path)
    assert "messages: 6\n" in said
    for topic, each in SENT.items():
        assert f"topic: {topic}\n      type: {each.type.schema_name.replace('/msg/', '/')}\n      messages: 2\n" in said
    assert "does not need any migrations" in run(rosbag, "check", path)


def test_rosbag_plays_our_bags(tmp_path: Path) -> None:
    """Also messages at time 0, which its player refuses: they are written as at 1 ns."""
    rosbag, rostopic, path = require("rosbag"), require("rostopic"), bag(tmp_path, [0, 10**8])
    with RosMaster() as master, ExitStack() as stack:
        listening = {
            topic: stack.enter_context(
                subprocess.Popen(
                    [PYTHON, rostopic, "echo", "-n", "2", topic],
                    env=dict(master.environment),
                    stdout=subprocess.PIPE,
                    stderr=subprocess.DEVNULL,
                    text=True,
                )
            )
            for topic in SENT
        }
        for each in listening.values():
            stack.callback(each.kill)
        run(rosbag, "play", "--quiet", "--wait-for-subscribers", path, environment=master.environment)
        heard = {topic: each.communicate(timeout=SECONDS)[0] for topic, each in listening.items()}
    assert heard == {topic: 2 * shown for topic, shown in SHOWN.items()}
