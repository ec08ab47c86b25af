"""Whether an objective can be played, before a job is accepted for it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from mesh.errors import InvalidKey
from mesh.recording.errors import RecordingError
from mesh.recording.limits import Limits
from mesh.recording.objective import Objective, open_objective
from schemas.chunks import topic_chunks
from schemas.errors import InvalidPayload
from schemas.values import decode_value

if TYPE_CHECKING:
    from collections.abc import Collection
    from pathlib import Path

_DEFAULT: Final = Limits()
_READ: Final = frozenset({"ros1", "json"})
"""The encodings some types of which are decoded here; all others travel as they are."""


@dataclass(frozen=True, kw_only=True)
class Preflight:
    """What came of looking at an objective.

    `reason` is machine-readable: empty if all is well, or one of `not-a-recording`, `too-large`, `expands-too-much`,
    `corrupt`, `no-messages`, `too-long`, `unplayable-topic`, `unknown-topic`, `unreadable-message` (one that is not
    what its own schema says). `detail` is for people. `objective` is there as soon as the file itself is sound.
    """

    reason: str = ""
    detail: str = ""
    objective: Objective | None = None

    @property
    def ok(self) -> bool:
        """Whether it can be played."""
        return not self.reason


def preflight(path: Path, limits: Limits = _DEFAULT, *, topics: Collection[str] | None = None) -> Preflight:
    """Look at the whole file at `path`; `topics` are those that the device takes (None: any).

    Reads the whole file: do so in a thread. Raises nothing for a bad file.
    """
    try:
        objective = open_objective(path, limits)
    except RecordingError as error:
        return Preflight(reason=error.reason, detail=str(error))
    reason, detail = _obstacle(objective, limits, topics)
    return Preflight(reason=reason, detail=detail, objective=objective)


def _obstacle(objective: Objective, limits: Limits, topics: Collection[str] | None) -> tuple[str, str]:
    if not objective.count:
        return "no-messages", "there is no message in it"
    if objective.duration_ns > limits.duration_ns:
        return "too-long", f"playing it takes {objective.duration_ns // 10**9} seconds"
    for topic in objective.topics:
        try:
            topic_chunks(topic.name)
        except InvalidKey as error:
            return "unplayable-topic", str(error)
        if topics is not None and topic.name not in topics:
            return "unknown-topic", f"nobody here takes {topic.name}"
    return _unreadable(objective)


def _unreadable(objective: Objective) -> tuple[str, str]:
    """The first message that a handler would choke on in the middle of the job."""
    if not any(topic.type.encoding in _READ for topic in objective.topics):
        return "", ""
    try:
        for number, message in enumerate(objective.messages()):
            if message.type.encoding in _READ:
                try:
                    decode_value(message.payload, message.type)
                except InvalidPayload as error:
                    return "unreadable-message", f"message {number} on {message.topic}: {error}"
    except RecordingError as error:
        return error.reason, str(error)
    return "", ""
