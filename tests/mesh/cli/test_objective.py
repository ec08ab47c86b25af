"""`aira objective`: what its commands print, write and refuse."""

from __future__ import annotations

import json
import sys
from typing import TYPE_CHECKING

import pytest

from mesh.agent.objectives import ObjectiveUnfit
from mesh.base.extras import PackageMissing
from mesh.cli.objective import PLOT_LIMITS, Line, lines_of
from mesh.cli.output import format_size
from mesh.content import Store
from mesh.errors import AiraError, InvalidCid
from mesh.recording import Played, Recorder, RecordingAbout, open_objective, pack
from mesh.recording._source import RecordingError
from schemas import cid_of_bytes, cid_of_file
from schemas.payloads import JSON, STRING, Empty, String, encode_value
from tests.support.bags import Bag, BagMessage, string
from tests.support.cli.calls import call
from tests.support.commands import refused, run
from tests.support.objectives import objective
from tests.support.orders import LIGHTHOUSE
from tests.support.recording.files import T0, with_messages

if TYPE_CHECKING:
    from pathlib import Path


LINES = b"""{"topic": "/blink"}
{"topic": "/blink", "time": 0.5, "value": "blue"}
{"topic": "/move", "time": 2, "value": {"x": 1}}
"""


@pytest.fixture(autouse=True)
def own_data(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A store of this test's own."""
    monkeypatch.setenv("AIRA_DATA_DIR", str(tmp_path / "data"))


@pytest.fixture
def sound(tmp_path: Path) -> Path:
    path = tmp_path / "sound.mcap"
    path.write_bytes(objective(("/go", "there"), ("/go", {"x": 1}), ("/stop", b"\1")))
    return path


def test_lines_become_an_objective(tmp_path: Path) -> None:
    (tmp_path / "lines").write_bytes(LINES)
    done = call("pack", tmp_path / "lines", "--out", tmp_path / "it.mcap")
    assert done.exit_code == 0, done.output
    made = tmp_path / "it.mcap"
    assert done.stdout == f"{cid_of_file(made)}  {made}  3 messages, 2 s, {format_size(made.stat().st_size)}\n"
    assert [(one.topic, one.log_time_ns) for one in open_objective(tmp_path / "it.mcap").messages()] == [
        ("/blink", 0),
        ("/blink", 500_000_000),
        ("/move", 2_000_000_000),
    ]


def test_lines_may_come_from_the_standard_input(tmp_path: Path) -> None:
    done = call("pack", "-", "--out", tmp_path / "it.mcap", "--json", given=LINES)
    assert json.loads(done.stdout) == {
        "cid": cid_of_file(tmp_path / "it.mcap"),
        "file": str(tmp_path / "it.mcap"),
        "size": (tmp_path / "it.mcap").stat().st_size,
        "messages": 3,
        "topics": ["/blink", "/move"],
        "durationNs": 2_000_000_000,
    }


def test_a_bag_is_packed_without_losing_anything(tmp_path: Path) -> None:
    bag = tmp_path / "it.bag"
    bag.write_bytes(Bag([BagMessage("/blink", string("blue"), T0)]).encode())
    assert call("pack", bag, "--out", tmp_path / "it.mcap").exit_code == 0
    assert open_objective(tmp_path / "it.mcap").metadata["aira"]["source"] == cid_of_file(bag)


def test_an_error_names_the_invalid_line_and_nothing_is_written(tmp_path: Path) -> None:
    done = call("pack", "-", "--out", tmp_path / "it.mcap", given=LINES + b'{"topic": "blink"}\n')
    refused(done, "invalid-line", "line 4", "blink")
    assert not (tmp_path / "it.mcap").exists()


@pytest.mark.parametrize(
    ("words", "error", "value"),
    [
        (["pack", "--out", "new"], "invalid-options", "SOURCE"),
        (["pack", "-", "--hear", "a", "--out", "new"], "invalid-options", "SOURCE"),
        (["pack", "missing", "--out", "new"], "file-unreadable", "missing"),
        (["pack", "missing", "--out", "/"], "file-exists", "/"),
        (["pack", "-", "--out", "nowhere/new"], "folder-missing", "nowhere"),
        (["pack", "--hear", "a//b", "--out", "new"], "invalid-destination", "a//b"),
        (["show", "missing"], "not-a-file-or-cid", "missing"),
        (["show", "."], "file-unreadable", "."),
        (["convert", "missing"], "file-unreadable", "missing"),
        (["add", "missing"], "file-unreadable", "missing"),
        (["recover", "missing"], "file-unreadable", "missing"),
        (["check", "missing"], "not-a-file-or-cid", "missing"),
        (["get", "Qm", "--out", "new"], InvalidCid, "Qm"),
    ],
)
def test_invalid_arguments_are_one_clear_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, words: list[str], error: type[AiraError], value: str
) -> None:
    monkeypatch.chdir(tmp_path)
    refused(call(*words), error, value)
    assert {path.name for path in tmp_path.iterdir()} <= {"data"}


def test_no_file_is_overwritten(tmp_path: Path, sound: Path) -> None:
    before = sound.read_bytes()
    for words in (["pack", "-", "--out"], ["get", cid_of_bytes(b"x"), "--out"], ["recover", sound, "--out"]):
        refused(call(*words, sound), "file-exists", sound)
    bag = tmp_path / "it.bag"
    bag.write_bytes(Bag([BagMessage("/blink", string("blue"), T0)]).encode())
    refused(call("convert", bag, sound), "file-exists", sound)
    assert sound.read_bytes() == before


def test_show_describes_a_file(sound: Path) -> None:
    done = call("show", sound)
    assert done.exit_code == 0, done.output
    lines = done.stdout.splitlines()
    assert lines[0].split() == ["cid", cid_of_file(sound)]
    assert lines[4].split() == ["duration", "0.04", "s"]
    assert lines[6].split() == ["topic", "type", "messages", "rate", "when"]
    assert lines[7].split()[:5] == ["/go", "std_msgs/String,", "raw", "2", "50/s"]
    assert lines[7].count("█") == 2
    assert lines[8].split()[:3] == ["/stop", "raw", "1"]


def test_show_lists_schemas_metadata_and_attachments(tmp_path: Path) -> None:
    with Recorder(tmp_path / "it.mcap", RecordingAbout(liability="0x\x1b[2J1")) as recorder:
        recorder.record("/a", String("x").encode(), STRING)
    done = call("show", tmp_path / "it.mcap", "--schemas")
    assert "  string data" in done.stdout
    assert "\x1b" not in done.stdout
    assert any(line.split() == ["liability", "0x\N{REPLACEMENT CHARACTER}[2J1"] for line in done.stdout.splitlines())


def test_show_prints_json(sound: Path) -> None:
    said = json.loads(call("show", sound, "--json").stdout)
    assert (said["cid"], said["messages"], said["format"]) == (cid_of_file(sound), 3, "mcap")
    assert said["topics"][0]["types"][1] == {
        "type": "application/json;raw",
        "schemaEncoding": "jsonschema",
        "schema": JSON.schema_data.decode(),
    }
    assert sum(said["counts"]["/go"]) == 2


def test_cat_prints_the_messages_of_a_topic(tmp_path: Path) -> None:
    path = tmp_path / "it.mcap"
    path.write_bytes(
        objective(("/say", String("a\x1b[2J")), ("/go", Empty()), ("/raw", b"\x01\x02"), ("/at", {"x": 1.5}))
    )
    done = call("cat", path)
    assert [line.split(maxsplit=2)[2] for line in done.stdout.splitlines()] == [
        '/say  "a\\u001b[2J"',
        "/go  null",
        "/raw  raw, 2 bytes: 01 02",
        '/at  {"x":1.5}',
    ]
    said = [
        json.loads(line)
        for line in call("cat", path, "--topic", "/at", "--topic", "/raw", "--json").stdout.splitlines()
    ]
    assert [(one["topic"], one.get("value"), one.get("base64")) for one in said] == [
        ("/raw", None, "AQI="),
        ("/at", {"x": 1.5}, None),
    ]
    refused(call("cat", "missing"), "not-a-file-or-cid", "missing")


@pytest.fixture
def measured(tmp_path: Path) -> Path:
    """A recording with numbers of every kind."""
    path = tmp_path / "measured.mcap"
    values = [("/speed", 1.5), ("/speed", float("nan")), ("/pose", {"x": 1, "at": {"y": True}, "name": "arm"})]
    values += [("/joints", [1, 2.5]), ("/volts", "0.5 1.5"), ("/raw", b"\1"), ("/name", "arm"), ("/volts", "0.75 2")]
    path.write_bytes(objective(*values))
    return path


def test_show_prints_messages_and_keeps_nan(measured: Path) -> None:
    assert call("show", measured, "--messages").stdout == call("cat", measured).stdout
    assert call("show", measured, "--topic", "/speed").stdout == call("cat", measured, "--topic", "/speed").stdout
    lines = call("show", measured, "--topic", "/speed").stdout.splitlines()
    assert [line.rpartition("  ")[2] for line in lines] == ["1.5", "NaN"]
    objects = [json.loads(line) for line in call("cat", measured, "--topic", "/speed", "--json").stdout.splitlines()]
    assert [one["value"] for one in objects] == [1.5, "nan"]


def test_a_plot_has_a_line_for_each_number(measured: Path) -> None:
    opened = open_objective(measured)
    topics = lines_of(opened.messages(), start_ns=opened.start_ns)
    assert {topic: {name: line.values for name, line in lines.items()} for topic, lines in topics.items()} == {
        "/speed": {"": [1.5, pytest.approx(float("nan"), nan_ok=True)]},
        "/pose": {".x": [1.0], ".at.y": [1.0]},
        "/joints": {"[0]": [1.0], "[1]": [2.5]},
        "/volts": {"[0]": [0.5, 0.75], "[1]": [1.5, 2.0]},
    }
    assert topics["/volts"]["[0]"].seconds == sorted(topics["/volts"]["[0]"].seconds) != [0.0, 0.0]


def test_a_plot_is_limited_in_topics_lines_and_points() -> None:
    payload, kind = encode_value({str(number): number for number in range(PLOT_LIMITS.lines + 5)})
    messages = [Played(f"/{n}", payload, n, n, 0, kind) for n in range(PLOT_LIMITS.topics + 5)]
    topics = lines_of(messages, start_ns=0)
    assert (len(topics), len(topics["/0"])) == (PLOT_LIMITS.topics, PLOT_LIMITS.lines)
    line = Line()
    for number in range(10 * PLOT_LIMITS.points):
        line.add(number, number)
    assert PLOT_LIMITS.points / 4 < len(line.values) <= PLOT_LIMITS.points
    assert line.values == line.seconds == [float(each) for each in range(0, 10 * PLOT_LIMITS.points, 16)]


def test_show_draws_a_plot(tmp_path: Path, sound: Path, measured: Path) -> None:
    for shown in (sound, measured):
        done = call("show", shown, "--png", tmp_path / "it.png")
        assert done.exit_code == 0, done.output
    assert (tmp_path / "it.png").read_bytes().startswith(b"\x89PNG\r\n")
    refused(call("show", sound, "--png", tmp_path / "nowhere" / "it.png"), "file-unwritable")


@pytest.mark.parametrize("number", ["1e308", "-1e308", "1" + "0" * 400, "[1e308,-1e308]", '{"a":1,"b":1e300}'])
def test_numbers_that_can_not_be_drawn_are_gaps_in_a_plot(tmp_path: Path, number: str) -> None:
    messages = [Played("/x", text.encode(), at, at, 0, JSON) for at, text in enumerate(["1", number, "2"], 1)]
    pack(messages, tmp_path / "huge.mcap")
    done = call("show", tmp_path / "huge.mcap", "--png", tmp_path / "it.png")
    assert done.exit_code == 0, done.output
    assert (tmp_path / "it.png").read_bytes().startswith(b"\x89PNG\r\n")


def test_without_matplotlib_the_error_says_how_to_install_it(
    tmp_path: Path, sound: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    done = call("show", sound, "--png", tmp_path / "it.png")
    refused(done, PackageMissing, "matplotlib")
    assert "pip install '.[plot]'" in done.stderr


def test_a_bag_is_converted_to_a_file_next_to_it(tmp_path: Path) -> None:
    bag = tmp_path / "it.bag"
    sent = [BagMessage("/blink", string(f"{n}"), T0 + n) for n in range(3)]
    bag.write_bytes(Bag(sent, "bz2").encode())
    done = call("convert", bag, "--json")
    made = tmp_path / "it.mcap"
    assert json.loads(done.stdout) == {
        "cid": cid_of_file(made),
        "file": str(made),
        "source": cid_of_file(bag),
        "messages": 3,
        "durationNs": 2,
        "leftOut": {},
    }
    assert [one.payload for one in open_objective(made).messages()] == [one.payload for one in sent]


def test_added_files_are_stored_and_pinned(tmp_path: Path, sound: Path) -> None:
    other = tmp_path / "other.mcap"
    other.write_bytes(with_messages([T0]))
    assert call("add", sound).stdout == f"{cid_of_file(sound)}\n"
    assert call("add", sound, other).stdout == f"{cid_of_file(sound)}  {sound}\n{cid_of_file(other)}  {other}\n"
    with Store(tmp_path / "data" / "content") as store:
        assert set(store.list()) == {cid_of_file(sound), cid_of_file(other)}
        assert store.pins()[cid_of_file(sound)] == {"user"}


def test_a_file_that_robots_refuse_is_added_with_an_error(tmp_path: Path, sound: Path) -> None:
    (tmp_path / "text").write_bytes(b"hello")
    done = call("add", tmp_path / "text", sound, "--json")
    assert done.exit_code == 2
    assert done.stderr.rstrip().endswith(f"[{ObjectiveUnfit.code}]")
    assert [added["reason"] for added in json.loads(done.stdout)] == ["not-a-recording", ""]


def test_adding_without_an_account_says_that_no_agent_serves_the_file(tmp_path: Path, sound: Path) -> None:
    assert "--keyfile" in call("add", sound).stderr
    keyfile = tmp_path / "key.json"
    keyfile.write_text(json.dumps({"version": 3, "address": LIGHTHOUSE[2:].lower(), "crypto": {}}))
    assert call("add", sound, "--keyfile", keyfile).stderr == ""


def test_a_playable_objective_passes_verification(sound: Path) -> None:
    done = call("check", sound)
    assert (done.exit_code, done.stdout) == (0, f"{cid_of_file(sound)}  valid: 3 messages, 0.04 s\n")
    call("add", sound)
    assert call("check", cid_of_file(sound)).stdout == done.stdout


@pytest.mark.parametrize(
    ("options", "reason"),
    [(["--topics", "/go"], "unknown-topic"), (["--objective-size-limit", "10"], "too-large")],
)
def test_an_unplayable_objective_fails_verification_with_an_exit_code(
    sound: Path, options: list[str], reason: str
) -> None:
    done = call("check", sound, "--json", *options)
    assert done.exit_code == 1
    said = json.loads(done.stdout)
    assert (said["ok"], said["reason"]) == (False, reason)
    assert call("check", sound, *options).stdout.startswith(f"{cid_of_file(sound)}  {reason}: ")


def test_a_damaged_file_in_the_store_is_reported(tmp_path: Path, sound: Path) -> None:
    call("add", sound)
    assert call("check").stdout.endswith(", 0 damaged\n")
    kept = tmp_path / "data" / "content" / cid_of_file(sound)
    kept.chmod(0o600)
    kept.write_bytes(sound.read_bytes()[:-1] + b"x")
    done = call("check", "--json")
    assert done.exit_code == 1
    assert json.loads(done.stdout)["damaged"] == [cid_of_file(sound)]


def test_the_readable_part_of_a_truncated_file_is_recovered(tmp_path: Path) -> None:
    (tmp_path / "it.mcap").write_bytes(with_messages([T0 + n for n in range(500)])[:3000])
    done = call("recover", tmp_path / "it.mcap", "--json")
    said = json.loads(done.stdout)
    saved = tmp_path / "it.recovered.mcap"
    assert (said["file"], said["cid"]) == (str(saved), cid_of_file(saved))
    assert 0 < said["messages"] == open_objective(saved).count < 500
    refused(call("recover", tmp_path / "it.mcap"), "recording-exists")
    (tmp_path / "text").write_bytes(b"hello")
    refused(call("recover", tmp_path / "text"), RecordingError, "text")


def test_reading_files_does_not_import_the_chain(sound: Path) -> None:
    program = (
        "import sys; from mesh.cli import main\n"
        f"main(['objective', 'show', {str(sound)!r}], standalone_mode=False)\n"
        "print([name for name in ('web3', 'eth_account', 'matplotlib') if name in sys.modules])"
    )
    assert run(sys.executable, "-c", program).stdout.splitlines()[-1] == "[]"
