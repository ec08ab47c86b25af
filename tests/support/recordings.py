"""Reading recordings as other programs do: with the decoders of the `mcap` packages."""

from __future__ import annotations

import json
import subprocess
from typing import TYPE_CHECKING, Any

from mcap.decoder import DecoderFactory
from mcap.reader import make_reader
from mcap_ros1.decoder import DecoderFactory as Ros1Decoders
from mcap_ros2.decoder import DecoderFactory as Ros2Decoders
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from mesh.recording._mcap import MAGIC
from peers.catalog import PEERS

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path

    from mcap.records import Schema


class JsonDecoders(DecoderFactory):
    """Decodes JSON, and refuses schemas that viewers refuse."""

    def decoder_for(self, message_encoding: str, schema: Schema | None) -> Callable[[bytes], Any] | None:
        if message_encoding != "json":
            return None
        assert schema is not None
        check_viewable(json.loads(schema.data))
        return json.loads


class InterfaceDecoders(DecoderFactory):
    """Decodes requests, replies, goals and feedback, whose names the ROS 2 decoders do not take (`Spawn_Request`)."""

    def decoder_for(self, message_encoding: str, schema: Schema | None) -> Callable[[bytes], Any] | None:
        if message_encoding != "cdr" or schema is None or "_" not in schema.name.rpartition("/")[2]:
            return None
        name, types = schema.name, get_typestore(Stores.EMPTY)
        found = get_types_from_msg(schema.data.decode(), name)
        types.register({each: defined for each, defined in found.items() if each not in types.fielddefs})
        return lambda payload: types.deserialize_cdr(payload, name)


def decoded(path: Path) -> list[tuple[str, Any]]:
    """Each message of an MCAP file: its topic, and the message. Raises if there is no decoder for one."""
    with path.open("rb") as stream:
        reader = make_reader(
            stream,
            validate_crcs=True,
            decoder_factories=[JsonDecoders(), Ros1Decoders(), InterfaceDecoders(), Ros2Decoders()],
        )
        return [(one.channel.topic, one.decoded_message) for one in reader.iter_decoded_messages()]


def check_recording(path: Path) -> None:
    """Fail unless other programs read an MCAP file without complaint; `mcap doctor` is one of them if it is here."""
    decoded(path)
    if (mcap := PEERS["mcap"].search()) is not None:
        done = subprocess.run([mcap, "doctor", path], capture_output=True, text=True, check=False)
        assert (done.returncode, done.stderr) == (0, ""), f"{path}: {done.stderr}"


def recordings_in(folder: Path) -> Iterator[Path]:
    """The complete MCAP files in a folder: stored ones, and copies."""
    for path in folder.rglob("*"):
        if path.is_file() and path.stat().st_size > len(MAGIC):
            with path.open("rb") as stream:
                start, _ = stream.read(len(MAGIC)), stream.seek(-len(MAGIC), 2)
                if start == stream.read() == MAGIC:
                    yield path


def check_viewable(schema: dict[str, Any]) -> None:
    """Fail if a JSON Schema is none that Foxglove and Lichtblick read: each part has one type; lists hold no lists."""
    assert schema["type"] == "object"
    for part in schema["properties"].values():
        if part["type"] == "array":
            part = part["items"]
            assert part["type"] != "array"
            assert "contentEncoding" not in part
        if part["type"] == "object":
            check_viewable(part)
        else:
            assert part["type"] in ("boolean", "string", "number", "integer")
