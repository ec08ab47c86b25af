from __future__ import annotations

import io
from typing import Any

import pytest
from mcap.reader import make_reader

from mesh.recording import Unrecordable
from mesh.recording.mcap_file import MAX_CHANNELS, McapFile
from schemas.payloads import RAW, PayloadType
from tests.mesh.recording.files import T0

GOOD: dict[str, Any] = {
    "topic": "/a",
    "payload": b"x",
    "type": RAW,
    "metadata": {"role": "device"},
    "log_time_ns": T0,
    "publish_time_ns": T0,
}


@pytest.mark.parametrize(
    "bad",
    [
        {"payload": "text"},
        {"log_time_ns": -1},
        {"publish_time_ns": 1 << 64},
        {"topic": "/\udcff"},
        {"type": PayloadType("ros1", "\udcff")},
        {"metadata": {"role": "\udcff"}},
    ],
)
def test_a_bad_argument_leaves_the_file_as_it_was(bad: dict[str, Any]) -> None:
    stream = io.BytesIO()
    file = McapFile(stream)
    file.add(**GOOD)
    with pytest.raises(Unrecordable):
        file.add(**(GOOD | bad))
    file.add(**GOOD)
    with pytest.raises(Unrecordable):
        file.add_metadata("x", {"y": "\udcff"})
    file.finish()
    found = list(make_reader(io.BytesIO(stream.getvalue()), validate_crcs=True).iter_messages())
    assert [(channel.topic, message.data) for _, channel, message in found] == [("/a", b"x")] * 2
    assert [message.sequence for _, _, message in found] == [0, 1]


def test_channels_beyond_what_the_format_can_number_are_refused() -> None:
    file = McapFile(io.BytesIO())
    for number in range(MAX_CHANNELS):
        file.add(**(GOOD | {"topic": f"/{number}"}))
    with pytest.raises(Unrecordable):
        file.add(**(GOOD | {"topic": "/one-more"}))
    file.add(**(GOOD | {"topic": "/0"}))
    assert file.messages == MAX_CHANNELS + 1
