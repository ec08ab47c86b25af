from __future__ import annotations

import os
from typing import TYPE_CHECKING

import pytest

from mesh.recording import Limits, preflight
from schemas.model import ModelDescription, ModelTopic
from schemas.value_schema import ValueSchema
from tests.mesh.recording.files import SECOND, T0, mcap_file, with_messages
from tests.support.bags import Bag, BagMessage, string
from tests.support.objectives import objective

if TYPE_CHECKING:
    from pathlib import Path

    from mcap.writer import Writer

GOOD = with_messages([T0, T0 + 8 * 24 * 3600 * SECOND - 1])


def on_topic(topic: str, payload: bytes = b"{}") -> bytes:
    def write(writer: Writer) -> None:
        writer.add_message(writer.register_channel(topic, "json", 0), T0, payload, T0)

    return mcap_file(write)


@pytest.mark.parametrize("content", [with_messages([T0]), Bag([BagMessage("/a", string("x"), T0)]).encode()])
def test_a_good_objective_is_returned_open(tmp_path: Path, content: bytes) -> None:
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
def test_an_unplayable_objective_has_a_reason(tmp_path: Path, content: bytes, reason: str) -> None:
    path = tmp_path / "objective"
    path.write_bytes(content)
    outcome = preflight(path, Limits(size=30_000, expanded=8000), topics={"/a", "/b", "a b", "/a/**"})
    assert not outcome.ok
    assert outcome.reason == reason
    assert outcome.detail
    assert (outcome.objective is None) == (reason in ("not-a-recording", "corrupt", "too-large", "expands-too-much"))


def test_without_a_device_any_topic_is_accepted(tmp_path: Path) -> None:
    path = tmp_path / "objective"
    path.write_bytes(on_topic("/whatever"))
    assert preflight(path).ok


def test_a_path_that_is_not_a_regular_file_is_not_a_recording(tmp_path: Path) -> None:
    assert preflight(tmp_path / "missing").reason == "not-a-recording"
    assert preflight(tmp_path).reason == "not-a-recording"
    os.mkfifo(tmp_path / "pipe")
    assert preflight(tmp_path / "pipe").reason == "not-a-recording"


@pytest.mark.parametrize(("kind", "payload"), [("std_msgs/String", b"\x09\0\0\0x"), ("std_msgs/Empty", b"x")])
def test_a_message_that_contradicts_its_type_is_reported(tmp_path: Path, kind: str, payload: bytes) -> None:
    path = tmp_path / "objective"
    path.write_bytes(Bag([BagMessage("/b", payload, T0 + n, type=kind) for n in range(3)]).encode())
    outcome = preflight(path)
    assert outcome.reason == "unreadable-message"
    assert outcome.detail.startswith(f"message 0 on /b: not a {kind}: ")


def test_an_unknown_type_is_accepted(tmp_path: Path) -> None:
    path = tmp_path / "objective"
    path.write_bytes(Bag([BagMessage("/b", b"\xff", T0, type="my/Type")]).encode())
    assert preflight(path).ok


def test_the_first_message_that_no_handler_accepts_is_reported(tmp_path: Path) -> None:
    path = tmp_path / "objective"

    def write(writer: Writer) -> None:
        channel = writer.register_channel("/a", "json", 0)
        for payload in (b"1", b"2", b"30", b"40"):
            writer.add_message(channel, T0, payload, T0)

    path.write_bytes(mcap_file(write))
    asked: list[tuple[str, object]] = []

    def obstacle(topic: str, said: object) -> str:
        asked.append((topic, said))
        return "it is too much" if said == 30 else ""

    outcome = preflight(path, obstacle=obstacle)
    assert (outcome.reason, outcome.detail) == ("unfit-message", "message 2 on /a: it is too much")
    assert asked == [("/a", 1), ("/a", 2), ("/a", 30)]


def test_too_much_json_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "objective"
    path.write_bytes(on_topic("/a", b"[" + b" " * 1000 + b"]"))
    assert preflight(path, Limits(json=1002)).ok
    assert preflight(path, Limits(json=1001)).reason == "expands-too-much"


MODEL = ModelDescription(
    title="Says a number",
    objective=(
        ModelTopic(topic="/a", value=ValueSchema(type="integer", minimum=1), required=True, max_messages=2),
        ModelTopic(topic="/b"),
    ),
)


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        (objective(("/a", 1), ("/b", "any")), ""),
        (objective(("/a", 0)), "unfit-message"),
        (objective(("/a", 1), ("/c", 1)), "unknown-topic"),
        (objective(("/b", 1)), "missing-topic"),
        (objective(("/a", 1), ("/a", 1), ("/a", 1)), "too-many-messages"),
    ],
)
def test_an_objective_fits_the_description_of_the_model(tmp_path: Path, content: bytes, reason: str) -> None:
    path = tmp_path / "objective"
    path.write_bytes(content)
    outcome = preflight(path, model=MODEL)
    assert (outcome.ok, outcome.reason) == (not reason, reason)
    assert bool(outcome.detail) is bool(reason)
