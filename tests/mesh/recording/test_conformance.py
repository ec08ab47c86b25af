"""The conformance files of the MCAP project, from the folder that MCAP_CONFORMANCE names."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any, Final

import pytest

from mesh.recording import open_objective

FOLDER: Final = os.environ.get("MCAP_CONFORMANCE", "")


@pytest.mark.skipif(not FOLDER, reason="MCAP_CONFORMANCE names no folder")
def test_all_conformance_files_read_as_specified() -> None:
    files = sorted(Path(FOLDER).rglob("*.mcap"))
    assert files
    assert {str(file): found for file in files if (found := read(file)) != specified(file)} == {}


def read(file: Path) -> list[Any]:
    """The messages, attachments and metadata of a file."""
    recording = open_objective(file)
    content = file.read_bytes()
    messages = [one.message for one in recording.in_file_order()]
    return [
        [(one.topic, one.sequence, one.log_time_ns, one.publish_time_ns, list(one.payload)) for one in messages],
        [
            (one.name, one.media_type, list(content[one.offset : one.offset + one.size]))
            for one in recording.attachments
        ],
        recording.metadata,
    ]


def specified(file: Path) -> list[Any]:
    """What its JSON file says of them: numbers are texts there."""
    said = [(one["type"], dict(one["fields"])) for one in json.loads(file.with_suffix(".json").read_text())["records"]]
    topics = {fields["id"]: fields["topic"] for kind, fields in said if kind == "Channel"}
    times = ("sequence", "log_time", "publish_time")
    return [
        [
            (topics[one["channel_id"]], *(int(one[name]) for name in times), [int(byte) for byte in one["data"]])
            for kind, one in said
            if kind == "Message"
        ],
        [
            (one["name"], one["media_type"], [int(byte) for byte in one["data"]])
            for kind, one in said
            if kind == "Attachment"
        ],
        {one["name"]: one["metadata"] for kind, one in said if kind == "Metadata"},
    ]
