"""Printing the messages of an objective or a recording."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

from mesh.cli.output import json_text, print_json, print_line, printable
from mesh.recording import GENEROUS, open_objective

if TYPE_CHECKING:
    from pathlib import Path

    from mesh.recording import Played

BYTES_SHOWN: Final = 32
"""How many bytes of a message without a known text are printed."""


def print_messages(path: Path, topics: frozenset[str], *, as_json: bool) -> None:
    """Print the messages on these topics (none given: on all). Raises `RecordingError`."""
    objective = open_objective(path, GENEROUS)
    for message in objective.messages():
        if topics and message.topic not in topics:
            continue
        if as_json:
            print_json(_facts(message))
        else:
            seconds = (message.log_time_ns - objective.start_ns) / 1e9
            role = f" ({printable(message.role)})" if message.role else ""
            print_line(f"{seconds:10.3f} s  {printable(message.topic)}{role}  {_text(message)}")


def _facts(message: Played) -> dict[str, Any]:
    facts = {
        "timeNs": message.log_time_ns,
        "topic": message.topic,
        "type": message.type.zenoh_encoding,
        "role": message.role,
    }
    value = message.value
    return facts | ({"base64": value} if isinstance(value, bytes) else {"value": value})


def _text(message: Played) -> str:
    value = message.value
    if isinstance(value, bytes):
        shown = value[:BYTES_SHOWN].hex(" ") + (" …" if len(value) > BYTES_SHOWN else "")
        return f"{printable(message.type.schema_name or message.type.encoding or 'bytes')}, {len(value)} bytes: {shown}"
    return printable(json_text(value))
