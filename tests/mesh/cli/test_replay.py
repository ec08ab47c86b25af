"""`aira replay`: which messages are published where and when, and what is refused."""

from __future__ import annotations

import json
import signal
import time
from typing import TYPE_CHECKING

import pytest
import zenoh
from click.testing import CliRunner

from mesh.chain.errors import NodeUnreachable
from mesh.cli import main
from mesh.content import Store
from mesh.content.store import ContentUnavailable
from mesh.errors import AiraError, InvalidKey, NetworkUnavailable
from mesh.recording import Recorder, RecordingAbout
from mesh.recording._source import NotARecording
from schemas import String, cid_of_bytes
from schemas.payloads import STRING
from tests.support.commands import AIRA, Serving, refused
from tests.support.listening import Listener
from tests.support.objectives import objective, timed
from tests.support.ports import free_endpoint
from tests.support.routers import client_config, wait_until_declared
from tests.support.waiting import at_most

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from click.testing import Result

    from tests.support.routers import EmbeddedRouter

ROBOT = f"0x{'1' * 40}"
SECOND = 10**9


@pytest.fixture
def listener(router: EmbeddedRouter) -> Iterator[Listener]:
    with zenoh.open(client_config(router.endpoint)) as session:
        listener = Listener(session)
        wait_until_declared(router.endpoint, "any/key")
        yield listener


class Stage:
    """A file, and the command that plays it."""

    def __init__(self, endpoint: str, folder: Path) -> None:
        self._endpoint = endpoint
        self.data = folder / "data"
        self.path = folder / "it.mcap"
        self.path.write_bytes(objective(("/go", "there"), ("/move/left", {"x": 1}), ("/go", b"\1")))

    def words(self, *words: str | Path) -> list[str]:
        options = ["--connect", self._endpoint, "--connect-timeout", "30", "--data-dir", self.data]
        return [str(word) for word in ["replay", *options, *words]]

    def play(self, *words: str | Path) -> Result:
        return CliRunner().invoke(main, self.words(*words))


@pytest.fixture
def stage(router: EmbeddedRouter, tmp_path: Path) -> Stage:
    return Stage(router.endpoint, tmp_path)


def test_a_file_is_published_on_the_topics_of_a_device(stage: Stage, listener: Listener) -> None:
    done = stage.play(stage.path, "--to", f"{ROBOT}/lamp")
    assert done.exit_code == 0, done.output
    assert done.stdout.startswith("3 messages in ")
    assert done.stderr == ""
    device = f"aira/agent/{ROBOT}/device/lamp"
    assert [(key, payload, encoding) for key, payload, encoding, _ in listener.heard(3)] == [
        (f"{device}/go", String("there").encode(), "ros1;std_msgs/String"),
        (f"{device}/move/left", b'{"x":1}', "application/json;raw"),
        (f"{device}/go", b"\1", "application/octet-stream;raw"),
    ]


def test_a_playback_that_nobody_hears_says_so(stage: Stage) -> None:
    done = stage.play(stage.path, "--to", f"{ROBOT}/absent", "--topics", "/go")
    assert done.stderr == f"aira: nobody listens on aira/agent/{ROBOT}/device/absent/go\n"
    assert done.exit_code == 0


def test_a_file_is_published_under_a_given_key_prefix(stage: Stage, listener: Listener) -> None:
    assert stage.play(stage.path, "--to", "lab/stage").exit_code == 0
    assert listener.keys(3) == ["lab/stage/go", "lab/stage/move/left", "lab/stage/go"]


def test_a_file_is_published_on_the_topics_of_ones_own_device(stage: Stage, listener: Listener, tmp_path: Path) -> None:
    keyfile, password = tmp_path / "key.json", tmp_path / "password"
    made = CliRunner().invoke(main, ["account", "new", str(keyfile), "--password-file", str(password)])
    own = made.stdout.split()[-1].lower()
    assert stage.play(stage.path, "--to", "lamp", "--keyfile", keyfile).exit_code == 0
    assert listener.keys(3)[0] == f"aira/agent/{own}/device/lamp/go"


def test_a_cid_is_played_from_the_store(stage: Stage, listener: Listener) -> None:
    with Store(stage.data / "content") as store:
        cid = store.put_file(stage.path)
    assert stage.play(cid, "--to", "lab/stage").exit_code == 0
    assert len(listener.keys(3)) == 3


def test_only_selected_topics_are_published(stage: Stage, listener: Listener) -> None:
    done = stage.play(stage.path, "--to", "lab/stage", "--topics", "/move/left", "--json")
    assert json.loads(done.stdout)["messages"] == 1
    assert listener.keys(1) == ["lab/stage/move/left"]


def test_only_messages_of_the_device_are_published(stage: Stage, listener: Listener, tmp_path: Path) -> None:
    with Recorder(tmp_path / "job.mcap", RecordingAbout()) as recorder:
        recorder.record("/go", String("there").encode(), STRING, role="objective")
        recorder.record("/gone", String("there").encode(), STRING, role="device")
    assert stage.play(tmp_path / "job.mcap", "--to", "lab/stage", "--role", "device").exit_code == 0
    assert listener.keys(1) == ["lab/stage/gone"]


def test_messages_are_published_at_their_own_times(stage: Stage, listener: Listener) -> None:
    stage.path.write_bytes(timed([("/go", "one", 0), ("/go", "two", SECOND // 2), ("/go", "three", SECOND)]))
    started = time.monotonic()
    assert stage.play(stage.path, "--to", "lab/stage").exit_code == 0
    # Not between two of them: each may be heard late.
    after = [at - started for *_, at in listener.heard(3)]
    assert (after[1] > 0.5, after[2] > 1.0) == (True, True), after


@pytest.mark.parametrize(
    ("options", "count"),
    [(["--rate", "1200"], 3), (["--at-once"], 3), (["--from", "599.5"], 1)],
    ids=str,
)
def test_a_high_rate_plays_ten_minutes_at_once(
    stage: Stage, listener: Listener, options: list[str], count: int
) -> None:
    stage.path.write_bytes(timed([("/go", "one", 0), ("/go", "two", SECOND), ("/go", "three", 600 * SECOND)]))
    with at_most(60):
        assert stage.play(stage.path, "--to", "lab/stage", *options).exit_code == 0
    assert len(listener.keys(count)) == count


def test_ctrl_c_ends_it(stage: Stage, listener: Listener) -> None:
    stage.path.write_bytes(timed([("/go", "one", 0), ("/go", "two", 3600 * SECOND)]))
    with Serving(*AIRA, *stage.words(stage.path, "--to", "lab/stage"), says="") as playing:
        assert listener.keys(1) == ["lab/stage/go"]
        assert (playing.end(signal.SIGINT)[0], playing.log()) == (130, "")


@pytest.mark.parametrize(
    ("words", "error", "value"),
    [
        (["missing", "--to", "a/b"], "not-a-file-or-cid", "missing"),
        ([".", "--to", "a/b"], "file-unreadable", "."),
        (["it.mcap"], "invalid-destination", "destination"),
        (["it.mcap", "--to", "lamp"], "account-missing", "lamp"),
        (["it.mcap", "--to", f"{ROBOT}/la mp"], InvalidKey, "la mp"),
        (["it.mcap", "--to", "a/**"], "invalid-destination", "a/**"),
        (["it.mcap", "--to", "a//b"], "invalid-destination", "a//b"),
        (["it.mcap", "--to", "a/b", "--topics", "/stop"], "unknown-topic", "/stop"),
        (["text", "--to", "a/b"], NotARecording, "text"),
        (["odd.mcap", "--to", "a/b"], InvalidKey, "a b"),
    ],
)
def test_invalid_arguments_are_one_clear_line_and_nothing_is_published(
    stage: Stage,
    listener: Listener,
    monkeypatch: pytest.MonkeyPatch,
    words: list[str],
    error: type[AiraError],
    value: str,
) -> None:
    monkeypatch.chdir(stage.path.parent)
    (stage.path.parent / "text").write_bytes(b"hello")
    (stage.path.parent / "odd.mcap").write_bytes(objective(("/fine", "x"), ("/a b", "x")))
    done = stage.play(*words)
    refused(done, error, value)
    assert listener.heard(0) == []


def test_a_missing_router_file_or_chain_is_one_clear_line(stage: Stage) -> None:
    nowhere = Stage(free_endpoint(), stage.path.parent)
    done = nowhere.play(stage.path, "--to", "a/b", "--connect-timeout", "0.2")
    refused(done, NetworkUnavailable)
    done = stage.play(cid_of_bytes(b"nobody's"), "--to", "a/b", "--fetch-timeout", "0.2")
    refused(done, ContentUnavailable)
    done = stage.play(ROBOT, "--web3-http-provider", "http://127.0.0.1:9")
    refused(done, NodeUnreachable)
