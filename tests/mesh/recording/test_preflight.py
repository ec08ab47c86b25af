from __future__ import annotations

import os
from typing import TYPE_CHECKING

import pytest

from mesh.recording import Limits, preflight
from tests.mesh.recording.files import SECOND, T0, mcap_file, with_messages
from tests.support.bags import Bag, Sent, string

if TYPE_CHECKING:
    from pathlib import Path

    from mcap.writer import Writer

GOOD = with_messages([T0, T0 + 8 * 24 * 3600 * SECOND - 1])


def on_topic(topic: str, payload: bytes = b"{}") -> bytes:
    def write(writer: Writer) -> None:
        writer.add_message(writer.register_channel(topic, "json", 0), T0, payload, T0)

    return mcap_file(write)


@pytest.mark.parametrize("content", [with_messages([T0]), Bag([Sent("/a", string("x"), T0)]).encode()])
def test_a_good_objective_comes_back_open(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "objective"
    path.write_bytes(content)
    outcome = preflight(path)
    assert outcome.ok
    assert outcome.reason == ""
    assert outcome.objective is not None
    assert outcome.objective.count == 1


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        (b"", "not-a-recording"),
        (b"hello, I am a text", "not-a-recording"),
        (b"#ROSBAG V1.2\n", "not-a-recording"),
        (GOOD[:-9], "corrupt"),
        (mcap_file(lambda writer: None), "no-messages"),
        (GOOD, "too-long"),
        (on_topic("a b"), "unplayable-topic"),
        (on_topic("/a/**"), "unplayable-topic"),
        (on_topic("/c"), "unknown-topic"),
        (on_topic("/a", b"{"), "unreadable-message"),
        (with_messages([T0] * 3000), "too-large"),
        (with_messages([T0] * 300), "expands-too-much"),
    ],
)
def test_what_can_not_be_played_is_told_by_a_word_for_programs(tmp_path: Path, content: bytes, reason: str) -> None:
    path = tmp_path / "objective"
    path.write_bytes(content)
    outcome = preflight(path, Limits(size=30_000, expanded=8000), topics={"/a", "/b", "a b", "/a/**"})
    assert not outcome.ok
    assert outcome.reason == reason
    assert outcome.detail
    assert (outcome.objective is None) == (reason in ("not-a-recording", "corrupt", "too-large", "expands-too-much"))


def test_any_topic_will_do_where_no_device_says_otherwise(tmp_path: Path) -> None:
    path = tmp_path / "objective"
    path.write_bytes(on_topic("/whatever"))
    assert preflight(path).ok


def test_what_is_no_file_is_no_recording(tmp_path: Path) -> None:
    assert preflight(tmp_path / "missing").reason == "not-a-recording"
    assert preflight(tmp_path).reason == "not-a-recording"
    os.mkfifo(tmp_path / "pipe")
    assert preflight(tmp_path / "pipe").reason == "not-a-recording"


@pytest.mark.parametrize(("kind", "payload"), [("std_msgs/String", b"\x09\0\0\0x"), ("std_msgs/Empty", b"x")])
def test_a_message_that_is_not_what_its_type_says_is_named(tmp_path: Path, kind: str, payload: bytes) -> None:
    path = tmp_path / "objective"
    path.write_bytes(Bag([Sent("/b", payload, T0 + n, type=kind) for n in range(3)]).encode())
    outcome = preflight(path)
    assert outcome.reason == "unreadable-message"
    assert outcome.detail.startswith(f"message 0 on /b: not a {kind}: ")


def test_a_type_that_nobody_here_knows_is_carried_as_it_is(tmp_path: Path) -> None:
    path = tmp_path / "objective"
    path.write_bytes(Bag([Sent("/b", b"\xff", T0, type="my/Type")]).encode())
    assert preflight(path).ok
