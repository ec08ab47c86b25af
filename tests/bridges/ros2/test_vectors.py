"""What other systems send, byte by byte (`vectors/README.md` says whose bytes they are)."""

from __future__ import annotations

import json
from typing import Any

import pytest

from bridges.ros2 import InvalidRosToken, RosEntity
from bridges.ros2.attachment import parse_attachment
from bridges.ros2.names import parse_topic_key, topic_key
from bridges.ros2.qos import RosQos, parse_qos
from bridges.ros2.tokens import RmwZenoh
from tests.bridges.ros2.definitions import ros_types
from tests.bridges.ros2.peers import VECTORS

RECORDED = {file.stem: json.loads(file.read_text()) for file in sorted(VECTORS.glob("*-*.json"))}
DISTRIBUTIONS = {name: "humble" if "humble" in name else "jazzy" for name in RECORDED}
SENT = [
    pytest.param(name, what, sent, id=f"{name}-{what}-{number}")
    for name, vectors in RECORDED.items()
    for what in ("samples", "requests", "replies")
    for number, sent in enumerate(vectors[what])
]
WRONG_HASHES = {"action_msgs/srv/CancelGoal": "RIHS01_022cb8eb7bbae4dedde27098187e94f435faa23942695d7fbc7335182d10baf1"}
"""Of hiroz 0.2.1. ROS 2 itself has RIHS01_573d8b0a… for that service."""
TOKENS = [pytest.param(name, token, id=token[-90:]) for name, it in RECORDED.items() for token in it["tokens"]]


@pytest.mark.parametrize(("name", "what", "sent"), SENT)
def test_keys_attachments_and_payloads_are_read_and_written_alike(name: str, what: str, sent: dict[str, Any]) -> None:
    domain, topic, kind, type_hash = parse_topic_key(sent["key"])
    assert topic_key(domain, topic, kind, type_hash) == sent["key"]
    data = bytes.fromhex(sent["attachment"])
    attached = parse_attachment(data)
    assert attached is not None
    assert attached.encode() == data
    types = ros_types(DISTRIBUTIONS[name])
    message = kind + {"samples": "", "requests": "_Request", "replies": "_Response"}[what]
    payload = bytes.fromhex(sent["payload"])
    assert types.encode(types.decode(message, payload)).data == payload


@pytest.mark.parametrize(("name", "token"), TOKENS)
def test_tokens_are_read_and_written_alike(name: str, token: str) -> None:
    rmw = RmwZenoh(0)
    entity = rmw.parse(token)
    written = rmw.token(entity).split("/")
    read = token.removesuffix("/backends:cpu:").split("/")
    if entity.kind != "node":
        # Values that a reader takes as given are left out by others, and written by us.
        assert parse_qos(written.pop()) == parse_qos(read.pop())
    # A root namespace has two forms.
    assert written == [part if part != "%%" else "%" for part in read]


@pytest.mark.parametrize(("name", "token"), TOKENS)
def test_hashes_of_types_are_those_that_others_compute(name: str, token: str) -> None:
    entity: RosEntity = RmwZenoh(0).parse(token)
    if entity.type and entity.type_hash != WRONG_HASHES.get(entity.type):
        assert ros_types(DISTRIBUTIONS[name]).type_hash(entity.type) == entity.type_hash


def test_replies_repeat_the_number_and_the_sender_of_the_request() -> None:
    for vectors in RECORDED.values():
        for reply in vectors["replies"]:
            attached = parse_attachment(bytes.fromhex(reply["attachment"]))
            assert attached is not None
            assert (attached.sequence, attached.gid) == (7, bytes(range(16)))


def _profiles(file: str) -> list[Any]:
    lines = [line for line in (VECTORS / file).read_text().splitlines() if not line.startswith("#")]
    return [pytest.param(*line.split("\t"), id=line.replace("\t", " ")) for line in lines]


def _profile(numbers: str) -> RosQos:
    reliability, durability, history, depth = (int(number) for number in numbers.split()[:4])
    return RosQos(
        depth,
        "best-effort" if reliability == 2 else "reliable",
        "transient-local" if durability == 1 else "volatile",
        "keep-all" if history == 2 else "keep-last",
    )


@pytest.mark.parametrize(
    ("numbers", "text"), [*_profiles("qos_grid.tsv"), *_profiles("qos_depths.tsv"), *_profiles("qos_durations.tsv")]
)
def test_what_rmw_zenoh_writes_of_a_profile_is_read(numbers: str, text: str) -> None:
    profile = _profile(numbers)
    assert parse_qos(text) == profile
    assert parse_qos(profile.encode()) == profile


@pytest.mark.parametrize(("text", "numbers"), _profiles("qos_decode.tsv"))
def test_what_rmw_zenoh_reads_is_read_and_what_it_refuses_is_refused(text: str, numbers: str) -> None:
    if numbers == "NULL":
        with pytest.raises(InvalidRosToken):
            parse_qos(text)
    else:
        assert parse_qos(text) == _profile(numbers)
