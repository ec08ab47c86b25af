"""Checking whether an objective can be played, before accepting a job with it."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

from mesh.errors import InvalidKey
from mesh.recording.errors import RecordingError, RecordingTooLarge
from mesh.recording.limits import Limits
from mesh.recording.objective import Objective, open_source
from schemas.agent_keys import topic_chunks
from schemas.errors import InvalidPayload
from schemas.payloads import decode_value
from schemas.value_schema import Effort

if TYPE_CHECKING:
    from collections.abc import Callable, Collection
    from pathlib import Path
    from typing import TypeAlias

    from mesh.content import Progress
    from mesh.recording.source import RecordingChannel
    from schemas.model import ModelDescription

    Obstacle: TypeAlias = Callable[[str, Any], str]
    """Returns why no handler accepts a message, given its topic and value; empty if one does."""

_DEFAULT: Final = Limits()
_LONGEST_JSON: Final = 4 << 20
"""Bytes of the longest JSON message that is decoded: as objects it takes twenty times as much."""
_MOST_VALUES: Final = 1_000_000
"""Values in arrays and objects that are compared with a model, which takes about a second; numbers in arrays are
compared faster, and not counted."""


@dataclass(frozen=True, kw_only=True)
class Preflight:
    """The outcome of checking an objective.

    `reason` is machine-readable: empty if the objective can be played, or one of `not-a-recording`, `too-large`,
    `expands-too-much`, `corrupt`, `no-messages`, `too-long`, `unplayable-topic`, `unknown-topic`, `unreadable-message`
    (its payload does not match its schema), `unfit-message` (no handler, or not the model, accepts it),
    `missing-topic`, `too-many-messages` (for the model). `detail` is for people. `objective` is set if the file itself
    is sound.
    """

    reason: str = ""
    detail: str = ""
    limit: str = ""
    """The field of `Limits` that the file exceeds, if that is the reason."""
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
    model: ModelDescription | None = None,
    progress: Progress | None = None,
) -> Preflight:
    """Check the whole file at `path`. Raises nothing for a bad file. Reads the whole file: use a thread.

    `topics` are those that the device accepts (None: any), `obstacle` finds messages that it does not accept, `model`
    describes what objectives play. `progress` is called with the bytes read, of all.
    """
    check = _MessageCheck(limits, obstacle, model)
    try:
        objective = Objective(open_source(path, limits, on_message=check.on_message, progress=progress))
    except RecordingError as error:
        limit = error.limit if isinstance(error, RecordingTooLarge) else ""
        return Preflight(reason=error.reason, detail=str(error), limit=limit)
    reason, detail = _recording_fault(objective, limits, topics)
    if not reason:
        reason, detail = check.reason, check.detail
    if not reason and model is not None:
        fault = model.objective_fault(check.counts, duration_ns=objective.duration_ns, size=objective.size)
        reason, detail = fault or ("", "")
    return Preflight(reason=reason, detail=detail, objective=objective)


def _recording_fault(objective: Objective, limits: Limits, topics: Collection[str] | None) -> tuple[str, str]:
    """What is wrong with the recording as a whole: a reason and a detail, or empty texts."""
    if not objective.count:
        return "no-messages", "it has no messages"
    if objective.duration_ns > limits.duration_ns:
        return "too-long", f"playing it takes {objective.duration_ns // 10**9} seconds"
    for topic in objective.topics:
        try:
            topic_chunks(topic.name)
        except InvalidKey as error:
            return "unplayable-topic", str(error)
        if topics is not None and topic.name not in topics:
            return "unknown-topic", f"no handler accepts {topic.name}"
    return "", ""


class _MessageCheck:
    """Finds the first message that would fail in the middle of the job."""

    def __init__(self, limits: Limits, obstacle: Obstacle | None, model: ModelDescription | None) -> None:
        self.reason = self.detail = ""
        self.counts: Counter[str] = Counter()
        """Messages by topic, until one has failed; only counted for a `model`."""
        self._model = model
        self._effort = Effort(_MOST_VALUES)
        self._most_json = limits.json
        self._obstacle = obstacle
        self._messages = 0
        self._json = 0

    def on_message(self, channel: RecordingChannel, payload: bytes) -> None:
        """Check the next message, unless one has failed already."""
        if self.reason:
            return
        if channel.type.encoding == "json":
            self._json += len(payload)
            if len(payload) > _LONGEST_JSON or self._json > self._most_json:
                self._fail("expands-too-much", channel, f"{len(payload)} bytes of JSON, {self._json} with those before")
                return
        try:
            said = decode_value(payload, channel.type)
        except InvalidPayload as error:
            self._fail("unreadable-message", channel, str(error))
            return
        fault = None
        if self._model is not None:
            fault = self._model.message_fault(channel.topic, channel.type, said, self._effort)
            self.counts[channel.topic] += 1
        if fault is not None:
            self._fail(fault.reason, channel, fault.detail)
        elif self._obstacle is not None and (why := self._obstacle(channel.topic, said)):
            self._fail("unfit-message", channel, why)
        self._messages += 1

    def _fail(self, reason: str, channel: RecordingChannel, why: str) -> None:
        self.reason, self.detail = reason, f"message {self._messages} on {channel.topic}: {why}"
