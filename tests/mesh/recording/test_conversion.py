from __future__ import annotations

from typing import TYPE_CHECKING

import pytest
from mcap.reader import make_reader

from mesh.recording import CorruptRecording, bag_to_mcap, open_objective
from tests.mesh.recording.files import SECOND, T0
from tests.support.bags import Bag, BagMessage, Compression, string

if TYPE_CHECKING:
    from pathlib import Path

SENT = [
    *(BagMessage("/blink", string(f"message {n}"), T0 + (n * 7 % 50) * SECOND) for n in range(50)),
    BagMessage("/ping", b"", T0, type="std_msgs/Empty", md5sum="d41d8cd98f00b204e9800998ecf8427e", definition=""),
]


@pytest.mark.parametrize("compression", ["none", "bz2", "lz4"])
def test_a_bag_becomes_mcap_without_losing_anything(tmp_path: Path, compression: Compression) -> None:
    bag = tmp_path / "it.bag"
    bag.write_bytes(Bag(SENT, compression, per_chunk=7).encode())
    path = bag_to_mcap(bag, tmp_path / "it.mcap", cid="QmTheBag")
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        assert reader.get_header().profile == "ros1"
        found = list(reader.iter_messages(log_time_order=False))
    assert [(channel.topic, one.log_time, one.data) for _, channel, one in found] == [
        (sent.topic, sent.time_ns, sent.payload) for sent in SENT
    ]
    for schema, channel, _ in found:
        sent = next(sent for sent in SENT if sent.topic == channel.topic)
        assert schema is not None
        assert (schema.name, schema.encoding, schema.data) == (sent.type, "ros1msg", sent.definition.encode())
        assert channel.message_encoding == "ros1"
        assert channel.metadata["md5sum"] == sent.md5sum
        assert channel.metadata["callerid"] == "/tester"
    objective = open_objective(path)
    assert objective.metadata["aira"] == {"source": "QmTheBag", "source_format": "bag"}
    played = [(one.topic, one.payload, one.log_time_ns) for one in open_objective(bag).messages()]
    assert [(one.topic, one.payload, one.log_time_ns) for one in objective.messages()] == played


def test_a_bad_bag_leaves_no_file(tmp_path: Path) -> None:
    bag = tmp_path / "it.bag"
    bag.write_bytes(Bag(SENT).encode()[:5000])
    with pytest.raises(CorruptRecording):
        bag_to_mcap(bag, tmp_path / "it.mcap")
    assert [path.name for path in tmp_path.iterdir()] == ["it.bag"]
