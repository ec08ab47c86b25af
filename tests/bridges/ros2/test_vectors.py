"""What other systems send, byte by byte (`vectors/README.md` says whose bytes they are)."""

from __future__ import annotations

import json
from functools import cache
from typing import TYPE_CHECKING, Any

import pytest

from bridges.ros2._wire import RmwZenoh, RosQos, from_dds_type, parse_attachment, parse_qos
from schemas.errors import InputError
from tests.support.ros2.definitions import ros_types
from tests.support.ros2.peers import VECTORS

if TYPE_CHECKING:
    from bridges.ros2 import RosEntity

RECORDED = {file.stem: json.loads(file.read_text()) for file in sorted(VECTORS.glob("*-*.json"))}
DISTRIBUTIONS = {name: "humble" if "humble" in name else "jazzy" for name in RECORDED}
SENT = [
    pytest.param(name, what, sent, id=f"{name}-{what}-{number}")
    for name, vectors in RECORDED.items()
    for what in ("samples", "requests", "replies")
    for number, sent in enumerate(vectors[what])
]
CANCEL_GOAL = "action_msgs/srv/CancelGoal"
WRONG_HASHES = {CANCEL_GOAL: "RIHS01_022cb8eb7bbae4dedde27098187e94f435faa23942695d7fbc7335182d10baf1"}
"""Of hiroz 0.2.1."""
TOKENS = [pytest.param(name, token, id=token[-90:]) for name, it in RECORDED.items() for token in it["tokens"]]
types_of = cache(ros_types)


@pytest.mark.parametrize(("name", "what", "sent"), SENT)
def test_keys_attachments_and_payloads_are_read_and_written_alike(name: str, what: str, sent: dict[str, Any]) -> None:
    domain, _, rest = sent["key"].partition("/")
    topic, dds_type, type_hash = rest.rsplit("/", 2)
    kind = from_dds_type(dds_type)
    assert RmwZenoh(int(domain)).key(f"/{topic}", kind, type_hash) == sent["key"]
    data = bytes.fromhex(sent["attachment"])
    attached = parse_attachment(data)
    assert attached is not None
    assert attached.encode() == data
    types = types_of(DISTRIBUTIONS[name])
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
    assert written == read


@pytest.mark.parametrize(("name", "token"), TOKENS)
def test_hashes_of_types_are_those_that_others_compute(name: str, token: str) -> None:
    entity: RosEntity = RmwZenoh(0).parse(token)
    if entity.type and entity.type_hash != WRONG_HASHES.get(entity.type):
        assert types_of(DISTRIBUTIONS[name]).type_hash(entity.type) == entity.type_hash


def test_the_hash_of_the_service_that_cancels_goals_is_that_of_ros_2() -> None:
    # As `ros2 action info --verbose` prints it.
    known = "RIHS01_573d8b0a534451d7bc2ac8c5ffde8ac14b8593b7001175d0cd6516dcbeb8689a"
    assert types_of("jazzy").type_hash(CANCEL_GOAL) == known


def test_replies_repeat_the_number_and_the_sender_of_the_request() -> None:
    for vectors in RECORDED.values():
        for reply in vectors["replies"]:
            attached = parse_attachment(bytes.fromhex(reply["attachment"]))
            assert attached is not None
            assert (attached.sequence, attached.gid) == (7, bytes(range(16)))


def _profiles(file: str) -> list[list[str]]:
    lines = (VECTORS / file).read_text().splitlines()
    return [line.split("\t") for line in lines if not line.startswith("#")]


def _profile(numbers: str) -> RosQos:
    reliability, durability, history, depth = (int(number) for number in numbers.split()[:4])
    return RosQos(
        depth,
        "best-effort" if reliability == 2 else "reliable",
        "transient-local" if durability == 1 else "volatile",
        "keep-all" if history == 2 else "keep-last",
    )


@pytest.mark.parametrize("file", ["qos_grid.tsv", "qos_depths.tsv", "qos_durations.tsv"])
def test_what_rmw_zenoh_writes_of_a_profile_is_read(file: str) -> None:
    for numbers, text in _profiles(file):
        profile = _profile(numbers)
        assert parse_qos(text) == profile, text
        assert parse_qos(profile.encode()) == profile


def test_what_rmw_zenoh_reads_is_read_and_what_it_refuses_is_refused() -> None:
    for text, numbers in _profiles("qos_decode.tsv"):
        if numbers == "NULL":
            with pytest.raises(InputError):
                parse_qos(text)
        else:
            assert parse_qos(text) == _profile(numbers), text
