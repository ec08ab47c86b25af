"""Whether an objective can be played, before a job is accepted for it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

from mesh.errors import InvalidKey
from mesh.recording.errors import RecordingError
from mesh.recording.limits import Limits
from mesh.recording.objective import Objective, open_source
from schemas.errors import InvalidPayload
from schemas.key_chunks import topic_chunks
from schemas.payloads import decode_value

if TYPE_CHECKING:
    from collections.abc import Callable, Collection
    from pathlib import Path
    from typing import TypeAlias

    from mesh.content import Progress
    from mesh.recording.source import Channel

    Obstacle: TypeAlias = Callable[[str, Any], str]
    """Why nobody can do what a message asks, given its topic and what it says; empty if somebody can."""

_DEFAULT: Final = Limits()
_LONGEST_JSON: Final = 4 << 20
"""Bytes of a JSON message that are read: as objects they take twenty times as much."""


@dataclass(frozen=True, kw_only=True)
class Preflight:
    """What came of looking at an objective.

    `reason` is machine-readable: empty if all is well, or one of `not-a-recording`, `too-large`, `expands-too-much`,
    `corrupt`, `no-messages`, `too-long`, `unplayable-topic`, `unknown-topic`, `unreadable-message` (one that is not
    what its own schema says), `unfit-message` (one that no handler here can take). `detail` is for people. `objective`
    is there as soon as the file itself is sound.
    """

    reason: str = ""
    detail: str = ""
    objective: Objective | None = None

    @property
    def ok(self) -> bool:
        """Whether it can be played."""
        return not self.reason


def preflight(
    path: Path,
    limits: Limits = _DEFAULT,
    *,
    topics: Collection[str] | None = None,
    obstacle: Obstacle | None = None,
    progress: Progress | None = None,
) -> Preflight:
    """Look at the whole file at `path`; `topics` are those that the device takes (None: any), `obstacle` tells of
    messages that it does not, `progress` is told how many bytes of the file are read, of how many.

    Reads the whole file: do so in a thread. Raises nothing for a bad file.
    """
    reading = _Reading(limits, obstacle)
    try:
        objective = Objective(open_source(path, limits, look=reading.look, progress=progress))
    except RecordingError as error:
        return Preflight(reason=error.reason, detail=str(error))
    reason, detail = _misplaced(objective, limits, topics)
    if not reason:
        reason, detail = reading.reason, reading.detail
    return Preflight(reason=reason, detail=detail, objective=objective)


def _misplaced(objective: Objective, limits: Limits, topics: Collection[str] | None) -> tuple[str, str]:
    """What is wrong with the recording as a whole: a reason and a detail, or nothing."""
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
    return "", ""


class _Reading:
    """Finds the first message of a file that a handler would choke on in the middle of the job."""

    def __init__(self, limits: Limits, obstacle: Obstacle | None) -> None:
        self.reason = self.detail = ""
        self._most_json = limits.json
        self._obstacle = obstacle
        self._messages = 0
        self._json = 0

    def look(self, channel: Channel, payload: bytes) -> None:
        """Read the next message, unless there was one already."""
        if self.reason:
            return
        if channel.type.encoding == "json":
            self._json += len(payload)
            if len(payload) > _LONGEST_JSON or self._json > self._most_json:
                self._found(
                    "expands-too-much", channel, f"{len(payload)} bytes of JSON, {self._json} with those before"
                )
                return
        try:
            said = decode_value(payload, channel.type)
        except InvalidPayload as error:
            self._found("unreadable-message", channel, str(error))
            return
        why = self._obstacle(channel.topic, said) if self._obstacle is not None else ""
        if why:
            self._found("unfit-message", channel, why)
        self._messages += 1

    def _found(self, reason: str, channel: Channel, why: str) -> None:
        self.reason, self.detail = reason, f"message {self._messages} on {channel.topic}: {why}"
