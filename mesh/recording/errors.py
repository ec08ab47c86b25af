"""What is wrong with a recording that was given, or with one that is being made.

The branch `RecordingError` carries `reason`, a short machine-readable word; `preflight` reports the same words.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from mesh.errors import AiraError, InputError

if TYPE_CHECKING:
    from pathlib import Path


class RecordingError(InputError):
    """A file can't be taken as a recording. `reason` is machine-readable, `why` is for people."""

    code = "recording-error"

    def __init__(self, path: Path, why: str, *, reason: str, hint: str = "") -> None:
        super().__init__(f"{path.name}: {why}", hint=hint)
        self.path = path
        self.why = why
        self.reason = reason


class NotARecording(RecordingError):
    """A file is neither MCAP nor a ROS 1 bag, or can't be read at all."""

    code = "not-a-recording"

    def __init__(self, path: Path, why: str) -> None:
        super().__init__(path, why, reason="not-a-recording", hint="an objective is an MCAP file or a ROS 1 bag")


class CorruptRecording(RecordingError):
    """A file says that it is a recording, and then is none: cut off, mutated, or never one."""

    code = "corrupt-recording"

    def __init__(self, path: Path, why: str) -> None:
        super().__init__(
            path, why, reason="corrupt", hint="make it again, or save what is readable: `aira objective recover`"
        )


class RecordingTooLarge(RecordingError):
    """A recording is over a limit; `reason` is `too-large` (the file) or `expands-too-much` (what is in it)."""

    code = "recording-too-large"

    def __init__(self, path: Path, why: str, *, reason: str = "expands-too-much") -> None:
        super().__init__(path, why, reason=reason, hint="raise the limits, or make the recording smaller")


class Unrecordable(InputError):
    """A message can't be recorded as it was given; nothing was written."""

    code = "unrecordable"


class RecordingExists(InputError):
    """A finished recording is there under that name already; none is ever overwritten."""

    code = "recording-exists"

    def __init__(self, path: Path) -> None:
        super().__init__(f"{path} is there already", hint="record under another name, or move it away")
        self.path = path


class RecordingFailed(AiraError):
    """The disk refused the recording; what was on it by then can be recovered."""

    code = "recording-failed"

    def __init__(self, path: Path, why: str) -> None:
        super().__init__(f"can't go on recording {path}: {why}", hint="make room on the disk, then recover the file")
        self.path = path
        self.why = why


__all__ = [
    "CorruptRecording",
    "NotARecording",
    "RecordingError",
    "RecordingExists",
    "RecordingFailed",
    "RecordingTooLarge",
    "Unrecordable",
]
