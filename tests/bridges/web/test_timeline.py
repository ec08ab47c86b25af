"""The timeline of a job never runs backwards, whatever the clocks of chain and machine say."""

from __future__ import annotations

from typing import Any

from bridges.web._views import timeline_of


def step(kind: str, at: float | None) -> dict[str, Any]:
    return {"kind": kind, "at": at}


def test_a_chain_whose_clock_is_ahead_does_not_turn_the_timeline() -> None:
    steps = [step("created", 139.0), step("ready", 102.0), step("paid", 104.0), step("result", 104.5)]
    told = [(one["kind"], one["at"]) for one in timeline_of(steps)]
    assert told == [("created", 102.0), ("ready", 102.0), ("result", 104.0), ("paid", 104.0)]


def test_a_step_without_a_time_stays_without() -> None:
    told = timeline_of([step("paid", 7.0), step("reverted", None), step("created", 5.0)])
    assert [one["at"] for one in told] == [5.0, None, 7.0]
