"""Errors of reading and making recordings. A `RecordingError` has a machine-readable `reason`, as in `preflight`."""

from __future__ import annotations

from typing import TYPE_CHECKING

from mesh.errors import AiraError, InputError

if TYPE_CHECKING:
    from pathlib import Path


class RecordingError(InputError, code="recording-error"):
    """A file is not usable as a recording. `reason` is machine-readable, `why` is for people."""

    def __init__(self, path: Path, why: str, *, reason: str, hint: str = "") -> None:
        super().__init__(f"{path.name}: {why}", hint=hint)
        self.path = path
        self.why = why
        self.reason = reason


class NotARecording(RecordingError, code="not-a-recording"):
    """A file is neither MCAP, nor a ROS 1 bag, nor of rosbag2, or can't be read at all."""

    def __init__(self, path: Path, why: str) -> None:
        super().__init__(
            path, why, reason="not-a-recording", hint="an objective is an MCAP file, a ROS 1 bag, or a file of rosbag2"
        )


class CorruptRecording(RecordingError, code="corrupt-recording"):
    """A file begins as a recording, but is cut off or damaged."""

    def __init__(self, path: Path, why: str) -> None:
        super().__init__(
            path, why, reason="corrupt", hint="record it again, or recover the readable part: `aira objective recover`"
        )


class RecordingTooLarge(RecordingError, code="recording-too-large"):
    """A recording is over a limit; `limit` is the field of `Limits`.

    `reason` is `too-large` for the size of the file, `expands-too-much` for any other limit.
    """

    def __init__(self, path: Path, why: str, *, limit: str) -> None:
        reason = "too-large" if limit == "size" else "expands-too-much"
        self.limit = limit
        super().__init__(path, why, reason=reason, hint="raise the limits, or use a smaller recording")


class Unrecordable(InputError, code="unrecordable"):
    """No recording can hold this message; nothing of it was written."""


class RecordingExists(InputError, code="recording-exists"):
    """A recording of that name exists; none is ever overwritten."""

    def __init__(self, path: Path) -> None:
        super().__init__(f"{path} already exists", hint="choose another name, or move it away")
        self.path = path


class RecordingFailed(AiraError, code="recording-failed"):
    """The disk refused the recording; what was written before can be recovered."""

    def __init__(self, path: Path, why: str) -> None:
        super().__init__(f"can't record to {path}: {why}", hint="free space on the disk, then recover the file")
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
