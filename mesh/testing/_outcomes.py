"""How a job of a test ended, and what was recorded of it."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import msgspec

from mesh.agent.contracts import Outcome

if TYPE_CHECKING:
    from collections.abc import Iterable

    from mesh.recording import Played


class JobRecording:
    """The messages of a job: those of its objective, and what the robot and its devices published."""

    def __init__(self, messages: Iterable[Played] = ()) -> None:
        self.messages = tuple(messages)
        """In order, each with its topic, type, role and times."""

    def __repr__(self) -> str:
        return f"JobRecording({self.published!r})"

    @property
    def published(self) -> list[tuple[str, Any]]:
        """What the robot and its devices published, in order: topics and values."""
        return [(message.topic, message.value) for message in self.messages if message.role == "device"]

    def values(self, topic: str) -> list[Any]:
        """What was published on a topic, in order, as it was given to `Job.publish`; a Struct is a dict."""
        return [value for found, value in self.published if found == topic]


class RecordedOutcome(Outcome, frozen=True, kw_only=True):
    """An `Outcome`, with the recording at hand. Of a fake job, `success` says that the robot would be paid."""

    recording: JobRecording = msgspec.field(default_factory=JobRecording)
    """Empty if there is none."""
    seconds: float = 0.0
    """How long it took from the beginning to the end: for a fake job by its own clock, which `asyncio.sleep` advances
    at once."""
