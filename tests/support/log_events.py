"""The events in a captured log (`mesh.base.log_context.log_event`), for tests that assert names and fields."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import pytest


def logged_events(caplog: pytest.LogCaptureFixture) -> list[str]:
    """The names of the events that were logged, in order. Below WARNING only after `caplog.set_level`."""
    return [record.event for record in caplog.records if hasattr(record, "event")]


def logged_facts(caplog: pytest.LogCaptureFixture, event: str) -> list[dict[str, str]]:
    """The fields of each time that the event was logged."""
    return [vars(record)["facts"] for record in caplog.records if getattr(record, "event", "") == event]
