"""The jobs that an edge agent sees."""

from __future__ import annotations

from bridges.devices import JobTracker

AGENT = "0x" + "11" * 20
FIRST, SECOND = "0x" + "22" * 20, "0x" + "33" * 20


def event(liability: str, name: str) -> str:
    return f"aira/agent/{AGENT}/liability/{liability}/{name}"


def test_the_first_ready_job_is_current_until_it_is_complete() -> None:
    jobs = JobTracker()
    assert jobs.current == ""
    for liability in (FIRST, SECOND):
        jobs.handle_event(event(liability, "incoming"))
        jobs.handle_event(event(liability, "ready"))
    assert jobs.current == FIRST
    jobs.handle_event(event(FIRST, "complete"))
    assert jobs.current == SECOND
    jobs.handle_event(event(SECOND, "finalized"))
    assert jobs.current == ""


def test_a_command_of_another_job_makes_that_job_current() -> None:
    jobs = JobTracker()
    jobs.handle_event(event(FIRST, "ready"))
    jobs.begin(SECOND)
    assert jobs.current == SECOND
    jobs.handle_event(event(SECOND, "complete"))
    assert jobs.current == FIRST


def test_other_keys_change_nothing() -> None:
    jobs = JobTracker()
    for key in ("aira/x", event(FIRST, "objective/ready"), event("robot", "ready")):
        jobs.handle_event(key)
    assert jobs.current == ""
