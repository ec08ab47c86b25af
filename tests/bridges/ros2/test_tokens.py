"""Keys, tokens, attachments and hashes: vectors that a ROS 2 system published, and properties."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, Final

import pytest
from hypothesis import given
from hypothesis import strategies as st

from bridges.ros2 import RosEntity, RosQos
from bridges.ros2._services import add_definitions
from bridges.ros2._wire import (
    ATTACHMENT_SIZE,
    RmwZenoh,
    Ros2Dds,
    RosAttachment,
    from_dds_type,
    gid_of,
    parse_attachment,
    parse_qos,
    resolve,
    to_dds_type,
)
from mesh.recording.ros import RosTypes
from schemas.errors import InputError

VECTORS: Final[dict[str, Any]] = json.loads((Path(__file__).parent / "vectors" / "rmw_zenoh.json").read_text())
HASH: Final = "RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18"

names = st.from_regex(r"(/[A-Za-z_][A-Za-z0-9_]{0,9}){1,4}", fullmatch=True)
node_names = st.from_regex(r"[A-Za-z_][A-Za-z0-9_]{0,9}", fullmatch=True)
types = st.from_regex(r"[a-z][a-z0-9_]{0,9}/(msg|srv|action)/[A-Z][A-Za-z0-9_]{0,9}", fullmatch=True)
namespaces = st.just("") | names
numbers = st.integers(0, 2**31)
qualities = st.builds(
    RosQos,
    st.integers(0, 100_000),
    st.sampled_from(["reliable", "best-effort"]),
    st.sampled_from(["volatile", "transient-local"]),
    st.sampled_from(["keep-last", "keep-all"]),
)
sessions = st.from_regex(r"[0-9a-f]{1,32}", fullmatch=True)
nodes = st.builds(
    RosEntity, st.just("node"), st.integers(0, 232), sessions, numbers, numbers, node_names, namespaces, namespaces
)
endpoints = st.builds(
    RosEntity,
    st.sampled_from(["publisher", "subscription", "server", "client"]),
    st.integers(0, 232),
    sessions,
    numbers,
    numbers,
    node_names,
    namespaces,
    namespaces,
    names,
    types,
    st.just(HASH),
    qualities,
)


@pytest.fixture(scope="module")
def jazzy() -> RosTypes:
    ros = RosTypes("jazzy")
    add_definitions(ros)
    return ros


def test_the_tokens_of_a_ros_2_system_are_read(jazzy: RosTypes) -> None:
    parsed = [RmwZenoh(0).parse(token) for token in VECTORS["tokens"]]

    node, chatter, events, *servers = parsed
    assert (node.kind, node.node_name) == ("node", "/peer_talker")
    assert (chatter.kind, chatter.name, chatter.type, chatter.qos) == (
        "publisher",
        "/chatter",
        "std_msgs/msg/String",
        RosQos(10),
    )
    assert (events.qos.depth, events.qos.durability) == (1000, "transient-local")
    assert [server.name for server in servers] == ["/peer_talker/get_parameters", "/peer_talker/set_parameters"]
    for endpoint in parsed[1:]:
        assert jazzy.type_hash(endpoint.type) == endpoint.type_hash


def test_our_tokens_are_those_of_a_ros_2_system_with_explicit_quality_of_service() -> None:
    for token in VECTORS["tokens"]:
        ours = RmwZenoh(0).token(RmwZenoh(0).parse(token))
        assert ours.split("/")[:12] == token.split("/")[:12]
        assert parse_qos(ours.split("/")[-1]) == parse_qos(token.split("/")[-1]) if "NN" not in token else True


def test_keys_payloads_and_attachments_are_those_of_a_ros_2_system(jazzy: RosTypes) -> None:
    for number, sample in enumerate(VECTORS["samples"]):
        assert RmwZenoh(0).key("/chatter", "std_msgs/msg/String", jazzy.type_hash("std_msgs/String")) == sample["key"]
        payload = jazzy.message("std_msgs/String", data=f"Hello {number}").data
        assert payload == bytes.fromhex(sample["payload"])
        attached = bytes.fromhex(sample["attachment"])
        parsed = parse_attachment(attached)
        assert parsed is not None
        assert parsed.sequence == number
        assert parsed.encode() == attached


def test_the_identity_of_an_endpoint_is_the_xxh3_hash_of_its_token() -> None:
    import xxhash

    token = VECTORS["tokens"][1]
    number = xxhash.xxh3_128_intdigest(token.encode())
    low, high = number & (2**64 - 1), number >> 64
    assert gid_of(token) == low.to_bytes(8, "little") + high.to_bytes(8, "little")
    # The published hash of no bytes is 99aa06d3014798d86001c324468d497f, big-endian.
    assert gid_of("")[::-1].hex() == "99aa06d3014798d86001c324468d497f"


@pytest.mark.parametrize(
    ("name", "type_hash"),
    [
        ("std_msgs/Header", "f49fb3ae2cf070f793645ff749683ac6b06203e41c891e17701b1cb597ce6a01"),
        ("geometry_msgs/msg/TwistStamped", "5f0fcd4f81d5d06ad9b4c4c63e3ea51b82d6ae4d0558f1d475229b1121db6f64"),
        ("nav_msgs/Odometry", "3cc97dc7fb7502f8714462c526d369e35b603cfc34d946e3f2eda2766dfec6e0"),
        ("action_msgs/GoalStatusArray", "6c1684b00f177d37438febe6e709fc4e2b0d4248dca4854946f9ed8b30cda83e"),
        ("rcl_interfaces/srv/GetParameters", "bf9803d5c74cf989a5de3e0c2e99444599a627c7ff75f97b8c05b01003675cbc"),
        ("rcl_interfaces/srv/ListParameters", "3e6062bfbb27bfb8730d4cef2558221f51a11646d78e7bb30a1e83afac3aad9d"),
        ("rcl_interfaces/srv/DescribeParameters", "845b484d71eb0673dae682f2e3ba3c4851a65a3dcfb97bddd82c5b57e91e4cff"),
        (
            "action_tutorials_interfaces/action/Fibonacci_GetResult",
            "8b47e383f1e31f6d8df6417ab54957e7d5ea24dad315646ad711ac3fdea81d58",
        ),
    ],
)
def test_hashes_are_those_of_rosidl(name: str, type_hash: str) -> None:
    ros = RosTypes("jazzy")
    add_definitions(ros)
    fibonacci = "int32 order\n---\nint32[] sequence\n---\nint32[] partial_sequence\n"
    ros.register("action_tutorials_interfaces/Fibonacci", fibonacci)

    assert ros.type_hash(name) == f"RIHS01_{type_hash}"


def test_humble_has_no_hashes() -> None:
    ros = RosTypes("humble")
    add_definitions(ros)
    assert {ros.type_hash(name) for name in ("std_msgs/String", "std_srvs/srv/Trigger")} == {"TypeHashNotSupported"}


@given(entity=nodes | endpoints)
def test_what_we_show_is_what_others_read(entity: RosEntity) -> None:
    token = RmwZenoh(entity.domain).token(entity)
    assert RmwZenoh(entity.domain).parse(token) == entity
    assert len(gid_of(token)) == 16


@given(text=st.text(st.sampled_from("@ros2_lv/%0:1,MPSNaé§*")) | st.text())
def test_a_text_that_is_no_token_is_refused(text: str) -> None:
    for flavour in (RmwZenoh(0), Ros2Dds(0)):
        with pytest.raises(InputError):
            flavour.parse(text)


@given(data=st.data())
def test_a_damaged_token_is_refused_or_read(data: st.DataObject) -> None:
    token = data.draw(st.sampled_from(VECTORS["tokens"]))
    at = data.draw(st.integers(0, len(token) - 1))
    damaged = token[:at] + data.draw(st.text(max_size=3)) + token[at + data.draw(st.integers(0, 3)) :]
    try:
        entity = RmwZenoh(0).parse(damaged)
    except InputError:
        return
    assert RmwZenoh(0).parse(RmwZenoh(0).token(entity)) == entity or not entity.type


@given(sequence=st.integers(0, 2**63 - 1), time_ns=st.integers(0, 2**63 - 1), gid=st.binary(min_size=16, max_size=16))
def test_an_attachment_has_33_bytes_as_zenoh_serializes_them(sequence: int, time_ns: int, gid: bytes) -> None:
    from zenoh import ext

    attachment = RosAttachment(sequence, time_ns, gid)
    encoded = attachment.encode()

    assert len(encoded) == ATTACHMENT_SIZE == 33
    assert encoded == ext.z_serialize((ext.Int64(sequence), ext.Int64(time_ns), gid)).to_bytes()
    assert parse_attachment(encoded) == attachment


@given(
    sequence=st.integers(-(2**70), 2**70), time_ns=st.integers(-(2**70), 2**70), gid=st.binary(max_size=40) | st.none()
)
def test_no_other_attachment_can_be_made(sequence: int, time_ns: int, gid: bytes | None) -> None:
    try:
        encoded = RosAttachment(sequence, time_ns, gid or b"").encode()
    except ValueError:
        return
    assert parse_attachment(encoded) == (sequence, time_ns, gid)


@given(data=st.binary(max_size=80))
def test_a_malformed_attachment_is_none(data: bytes) -> None:
    parsed = parse_attachment(data)
    assert (parsed is not None) == (len(data) == 33 and data[16] == 16 and data[7] < 128)


@given(name=types)
def test_the_names_of_types_in_keys(name: str) -> None:
    assert from_dds_type(to_dds_type(name)) == name


@pytest.mark.parametrize(
    ("name", "absolute"),
    [("chatter", "/robot/chatter"), ("/chatter", "/chatter"), ("~/state", "/robot/arm/state"), ("a/b", "/robot/a/b")],
)
def test_names_are_resolved_for_a_node(name: str, absolute: str) -> None:
    assert resolve(name, "/robot", "arm") == absolute


@pytest.mark.parametrize("name", ["", "/", "//a", "/a/", "/1", "/a*", "/a b", "/a/%", "/é", "/" + "a" * 255])
def test_other_names_are_refused(name: str) -> None:
    with pytest.raises(InputError):
        resolve(name, "", "arm")


@given(entity=endpoints)
def test_tokens_of_the_dds_bridge(entity: RosEntity) -> None:
    dds = Ros2Dds(entity.domain)
    read = dds.parse(dds.token(entity))

    assert (read.kind, read.name, read.type, read.session) == (entity.kind, entity.name, entity.type, entity.session)
    if entity.kind in ("publisher", "subscription"):
        assert (read.type_hash, read.qos.durability) == (entity.type_hash, entity.qos.durability)


def test_an_action_of_the_dds_bridge_is_one_token() -> None:
    token = "@/a1/@ros2_lv/AS/ns§fibonacci/example_interfaces§action§Fibonacci"
    entity = Ros2Dds(0).parse(token)

    assert (entity.kind, entity.name) == ("server", "/ns/fibonacci/_action/send_goal")
    assert entity.type == "example_interfaces/action/Fibonacci_SendGoal"
    assert Ros2Dds(0).token(entity) == token
