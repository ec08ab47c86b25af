"""A narrator for tests."""

from __future__ import annotations

from typing import Any


class Recorder:
    """Keeps the names of the events, and the facts of the summary."""

    def __init__(self) -> None:
        self.events: list[str] = []
        self.facts: dict[str, Any] = {}

    def chapter(self, title: str) -> None:
        pass

    def event(self, who: str, event: str, text: str, **facts: Any) -> None:
        self.events.append(event)

    def summary(self, **facts: Any) -> None:
        self.facts = facts
