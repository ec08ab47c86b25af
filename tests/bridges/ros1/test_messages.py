"""Definitions, MD5 sums and payloads; the sums are those of the legacy network's own packages."""

from __future__ import annotations

from contextlib import suppress

import pytest
from hypothesis import given, strategies

from bridges.ros1._definitions import message_types, packages, service_types
from bridges.ros1.messages import TYPE_LIMITS, Ros1ServiceType, Ros1Type, plain
from schemas import InvalidPayload

SUMS = {
    "robonomics_liability/Liability": {
        "fdbfd87988140d754455ff400e534016",
        "38097f5457ea5a84d43c00f206c28642",
        "405eab9703e90a8fa8b18958e5709999",
        "05cfa8e702ff77000ac58a9fe4c430f0",
        "bfbed1b3b614dbb05af016d2c1c4cde6",
    },
    "robonomics_msgs/Demand": {
        "7293a088e011734d06846e54eb5b45b5",
        "62ade8590ead562d160ce53fff31159e",
        "636475baf02230a945752fc6d3c183e2",
        "43618daedb2ccd39731e4aeec694af5e",
    },
    "robonomics_msgs/Offer": {
        "14219b6373314c4a1bad508c6d1a391b",
        "aced796f75f8630cedfe1f980fc9c8d4",
        "d85dbad33a2122122858c4de71beaa25",
        "6b3bc0f1a03d7234a077386906156f18",
    },
    "robonomics_msgs/Result": {"25a1cb2f780b09d4bae1c2f4071212b1", "1fb2563171ed0677d1e6c9c8fa400d74"},
    "ethereum_common/TransferEvent": {"35f272b72902fee74cbfac3183ab4ae1"},
    "ethereum_common/ApprovalEvent": {"f1aefc216de0e824eacf1263c8aeb4df"},
    "robonomics_liability/StartLiability": {"ebc07382abd5516bf503d6260b124af7", "958b4ccc963946adb97fde4c3edb3bee"},
    "robonomics_liability/FinishLiability": {"26b15e2de4e826d98955e2304f45fe00", "eddc79601a91d011569841985ecff193"},
    "ethereum_common/AccountBalance": {"0f8190e3a314b4f0b718e5fba37da225"},
    "ethereum_common/Accounts": {"031c4bb89ac5ec75fbacab5f05cfa129"},
    "ethereum_common/TransferFrom": {"bdaad270cecdaddc8d27fbf972359604"},
    "robonomics_msgs/AddedOrderFeedback": {"44a43b54129dbaca91f41f0d5ebc3c02"},
    "robonomics_msgs/AddedPendingTransactionFeedback": {"8747c87ede16fb045387d990865a5819"},
    "robonomics_liability/PersistenceContainsLiability": {"24fc6757df6b230be4e2fb404a6dd2db"},
    "robonomics_liability/PersistenceLiabilityTimestamp": {"7812029465a9c6e94df201af9a1d9cde"},
}
POINT = "float64 x\nfloat64 y\n"
ALL = """\
# everything at once
byte KIND=3          # a constant
string NAME= not # a comment
Header header
my_msgs/Point[] path
Point[2] corners
string[] names
uint8[] data
char[4] word
duration took
bool done
int64[3] numbers
"""


@pytest.mark.parametrize("name", SUMS)
def test_the_sums_are_those_of_the_legacy_network(name: str) -> None:
    """One door serves all generations because it knows the sum of each."""
    known = message_types().get(name) or service_types()[name]
    assert SUMS[name] <= known.keys()


def test_a_message_of_many_kinds_of_fields_survives() -> None:
    """Encoded and decoded, constants left out; what is not given is zero."""
    kind = Ros1Type("my_msgs/All", ALL, {"my_msgs/Point": POINT})
    values = {
        "header": {"seq": 7, "stamp": (1, 2), "frame_id": "map"},
        "path": [{"x": 1.0, "y": 2.0}],
        "names": ["a", "ü"],
        "data": b"\x01\x02",
        "took": (-1, 5),
        "done": True,
        "numbers": [1, 2, -3],
    }
    zero = {"corners": [{"x": 0.0, "y": 0.0}] * 2, "word": bytes(4)}
    assert kind.decode(kind.encode(values)) == values | zero


@pytest.mark.parametrize("name", message_types())
def test_rosbags_finds_the_same_sums_in_the_definitions(name: str) -> None:
    """Of every message in every version, by the text that goes to recordings and connections."""
    pytest.importorskip("rosbags")
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    package, _, short = name.partition("/")
    for md5, kind in message_types()[name].items():
        store = get_typestore(Stores.ROS1_NOETIC if "Header" in kind.definition else Stores.EMPTY)
        store.register(get_types_from_msg(kind.definition, f"{package}/msg/{short}"))
        assert store.generate_msgdef(f"{package}/msg/{short}", ros_version=1)[1] == md5


def test_a_definition_read_again_has_the_same_sum() -> None:
    """The text that goes to recordings and connections holds the types in it."""
    kind = Ros1Type("my_msgs/All", ALL, {"my_msgs/Point": POINT})
    again = Ros1Type("my_msgs/All", kind.definition)
    assert again.md5 == kind.md5
    assert again.payload_type == kind.payload_type


def test_a_type_of_one_field_takes_its_value_alone() -> None:
    """An address is a text here, whatever a generation calls it."""
    for kind in message_types()["robonomics_msgs/Result"].values():
        values = {"liability": "0xabc", "result": "Qm", "success": True, "signature": b"s"}
        assert {name: plain(value) for name, value in kind.decode(kind.encode(values)).items()} == values


@pytest.mark.parametrize(
    "definition",
    [
        "Point point\n",
        "uint8 x y\n",
        "uint32[99999999] x\n",
        "Self self\n"
        + "=" * 80
        + "\nMSG: my_msgs/Self\nmy_msgs/Bad bad\n"
        + "=" * 80
        + "\nMSG: my_msgs/Bad\nSelf self\n",
        "# " + "x" * TYPE_LIMITS.definition,
    ],
    ids=["unknown", "no field", "too large", "within itself", "too long"],
)
def test_a_bad_definition_is_refused(definition: str) -> None:
    """Definitions come from other programs."""
    with pytest.raises(InvalidPayload):
        Ros1Type("my_msgs/Bad", definition)


@given(strategies.binary(max_size=200))
def test_any_bytes_are_decoded_or_refused(payload: bytes) -> None:
    """Payloads come from other programs."""
    kind = Ros1Type("my_msgs/All", ALL, {"my_msgs/Point": POINT})
    with suppress(InvalidPayload):
        assert kind.encode(kind.decode(payload))


def test_a_service_without_fields_has_the_sum_of_nothing() -> None:
    """std_srvs/Empty."""
    assert Ros1ServiceType("std_srvs/Empty", "---\n").md5 == "d41d8cd98f00b204e9800998ecf8427e"


def test_a_package_has_the_messages_of_its_generation() -> None:
    """In 2018 Multihash was in robonomics_msgs, and there was no ipfs_common."""
    assert "msg/Multihash.msg" in packages("3")["robonomics_msgs"]
    assert "ipfs_common" not in packages("3")
    assert "msg/Multihash.msg" in packages("4")["ipfs_common"]
    assert packages("3")["robonomics_msgs"]["msg/Demand.msg"].splitlines()[3] == "uint32 cost"
