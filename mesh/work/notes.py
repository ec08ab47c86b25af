"""Why a job failed: the note at the end of its recording, which the agent writes and its client reads.

A note is one line of text and the error's code, as in `the lamp is broken [job-failed]`.
"""

from __future__ import annotations

import re
from traceback import format_exception_only
from typing import TYPE_CHECKING, Final, NamedTuple

from mesh.errors import AiraError
from mesh.recording import GENEROUS, NOTE_TOPIC, open_objective
from schemas.errors import InvalidPayload
from schemas.payloads import String

if TYPE_CHECKING:
    from pathlib import Path

HANDLER_FAILED: Final = "handler-failed"
"""The code of an exception that has none: one of a handler's own."""
LONGEST: Final = 1000
"""Characters of a note that are read."""
_CODE: Final = re.compile(r"(.*) \[([a-z0-9-]{1,64})\]", re.DOTALL)


class Reason(NamedTuple):
    """Why a job failed. Both are empty if nothing says so."""

    text: str = ""
    code: str = ""


def note_of(error: Exception) -> str:
    """The note for an error that ended a job."""
    if isinstance(error, AiraError):
        return f"{str(error) or type(error).__name__} [{error.code}]"
    return f"{''.join(format_exception_only(error)).strip()} [{HANDLER_FAILED}]"


def read_reason(recording: Path) -> Reason:
    """What the last note of a recording says. Use a thread. Raises `RecordingError` if it is none."""
    note = ""
    for message in open_objective(recording, GENEROUS).messages():
        if message.topic == NOTE_TOPIC:
            try:
                note = String.decode(message.payload).data[:LONGEST]
            except InvalidPayload:
                continue  # the recording is a stranger's: what is no text says nothing
    found = _CODE.fullmatch(note)
    return Reason(note) if found is None else Reason(*found.groups())
