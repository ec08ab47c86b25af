"""The three bags of the legacy tutorial, rebuilt byte for byte: they have their published CIDs."""

from __future__ import annotations

import struct
from typing import TYPE_CHECKING, NamedTuple

import pytest

from mesh.recording import convert, open_objective, preflight
from schemas import Empty, String, cid_of_file
from schemas.payloads import decode_value
from tests.support.bags import MAGIC, fields, record, string

if TYPE_CHECKING:
    from pathlib import Path

CHUNK = 4117
ONE, NONE = struct.pack("<I", 1), bytes(4)


class Tutorial(NamedTuple):
    """A bag of one message on /blink. `begin_ns` is the start of its chunk; fields in the order of its writer."""

    cid: str
    payload: bytes
    says: Empty | String
    time_ns: int
    begin_ns: int
    connection: tuple[str, ...]
    orders: dict[bytes, str]


FORWARD = {
    b"\x03": "op index_pos conn_count chunk_count",
    b"\x05": "op compression size",
    b"\x07": "op topic conn",
    b"\x02": "op conn time",
    b"\x04": "op conn ver count",
    b"\x06": "op ver chunk_pos start_time end_time count",
}
BACKWARD = {
    b"\x03": "chunk_count conn_count index_pos op",
    b"\x05": "size compression op",
    b"\x07": "topic conn op",
    b"\x02": "time conn op",
    b"\x04": "count ver conn op",
    b"\x06": "count ver start_time chunk_pos end_time op",
}
EMPTY = ("topic=/blink", "type=std_msgs/Empty", "md5sum=d41d8cd98f00b204e9800998ecf8427e", "message_definition=")
TEXT = (
    "topic=/blink",
    "message_definition=string data\n",
    "md5sum=992ce8a1687cec8c8bd883ec73ca41d1",
    "type=std_msgs/String",
)
TUTORIALS = {
    "blink": Tutorial(
        "QmYYZWNd9esP3YBuuyUBVMH3ymaLDbQFB35S79duYiobcD",
        b"",
        Empty(),
        1535622771_261165857,
        1535622741_719170808,
        EMPTY,
        FORWARD,
    ),
    "blink_blue": Tutorial(
        "QmUq7d4jATFnbDgtkv83d3VW9jRqqCRkctZdGUBZE5wGN2",
        string("blue"),
        String("blue"),
        1539268250_179644107,
        1539268250_179644107,
        TEXT,
        BACKWARD,
    ),
    "blink_red": Tutorial(
        "QmcoE93MrvAdC789vt6G27WypSimhZxu5ZT2aKy8uviBDM",
        string("red"),
        String("red"),
        1539268206_348491907,
        1539268206_348491907,
        TEXT,
        BACKWARD,
    ),
}


def made(tutorial: Tutorial) -> bytes:
    """The bytes of the bag."""

    def part(opcode: bytes, data: bytes, **values: bytes) -> bytes:
        values["op"] = opcode
        return record({name: values[name] for name in tutorial.orders[opcode].split()}, data)

    described = fields({name: value.encode() for name, _, value in (one.partition("=") for one in tutorial.connection)})
    connection = part(b"\x07", described, topic=b"/blink", conn=NONE)
    said = connection + part(b"\x02", tutorial.payload, conn=NONE, time=ros(tutorial.time_ns))
    chunk = part(b"\x05", said, compression=b"none", size=struct.pack("<I", len(said)))
    place = ros(tutorial.time_ns) + struct.pack("<I", len(connection))
    chunk += part(b"\x04", place, conn=NONE, ver=ONE, count=ONE)
    info = part(
        b"\x06",
        NONE + ONE,
        ver=ONE,
        count=ONE,
        chunk_pos=struct.pack("<Q", CHUNK),
        start_time=ros(tutorial.begin_ns),
        end_time=ros(tutorial.time_ns),
    )
    index = struct.pack("<Q", CHUNK + len(chunk))
    head = part(b"\x03", b" " * 4027, index_pos=index, conn_count=ONE, chunk_count=ONE)
    return MAGIC + head + chunk + connection + info


def ros(nanoseconds: int) -> bytes:
    return struct.pack("<II", nanoseconds // 10**9, nanoseconds % 10**9)


@pytest.fixture(params=TUTORIALS)
def tutorial(request: pytest.FixtureRequest) -> Tutorial:
    return TUTORIALS[request.param]


@pytest.fixture
def bag(tmp_path: Path, tutorial: Tutorial) -> Path:
    path = tmp_path / "tutorial.bag"
    path.write_bytes(made(tutorial))
    return path


def test_a_tutorial_has_its_published_cid(bag: Path, tutorial: Tutorial) -> None:
    assert cid_of_file(bag) == tutorial.cid


def test_a_tutorial_has_its_one_message(bag: Path, tutorial: Tutorial) -> None:
    outcome = preflight(bag, topics={"/blink"})
    assert outcome.ok
    assert outcome.objective is not None
    (message,) = outcome.objective.messages()
    assert (message.topic, message.payload, message.log_time_ns) == ("/blink", tutorial.payload, tutorial.time_ns)
    assert decode_value(message.payload, message.type) == tutorial.says


def test_a_tutorial_is_unchanged_as_mcap(bag: Path, tutorial: Tutorial) -> None:
    converted = open_objective(convert(bag, bag.with_suffix(".mcap"), to="mcap", cid=tutorial.cid).path)
    assert converted.metadata["aira"] == {"source": tutorial.cid, "source_format": "bag"}
    assert list(converted.messages()) == list(open_objective(bag).messages())
