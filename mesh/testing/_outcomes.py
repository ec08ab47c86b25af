"""How a job of a test ended, what was recorded of it, assertions about that, and what a validator would say of it.

What they say when they fail is what a person would look for next.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

import msgspec

from mesh.agent.contracts import Outcome
from mesh.agent.handlers import Declined
from mesh.agent.hiring import DemandDeclined
from mesh.validator.judging import COMPLETE, Evidence
from schemas import Liability

if TYPE_CHECKING:
    from collections.abc import Iterable

    from mesh.recording import Played
    from mesh.validator.validator import Validator


ROBOT: Final = "0x00000000000000000000000000000000000000A1"
CONTRACT: Final = "0x00000000000000000000000000000000000000c1"
"""Addresses of nobody."""


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


def assert_paid(outcome: Outcome) -> None:
    """Raise `AssertionError`, with the reason of the failure, unless the job was done and its robot paid."""
    __tracebackhide__ = True
    if not outcome.success:
        raise AssertionError(f"the robot was not paid: {_reason(outcome)}{_published(outcome)}")


def assert_refunded(outcome: Outcome, *, code: str = "") -> None:
    """Raise `AssertionError` unless the job failed, so that its customer got the cost back; with `code`, for that."""
    __tracebackhide__ = True
    wanted = f"a refund with the code {code}" if code else "a refund"
    if outcome.success:
        raise AssertionError(f"expected {wanted}, but the robot was paid{_published(outcome)}")
    if code and outcome.code != code:
        raise AssertionError(f"expected {wanted}, but it was refunded for another reason: {_reason(outcome)}")


def assert_declined(error: BaseException, *, code: str = "") -> None:
    """Raise `AssertionError` unless `error` says that robots declined; with `code`, at least one of them for that.

    It is what ordering raises, a `DemandDeclined`, or what a handler raises, a `Declined`:

        with pytest.raises(DemandDeclined) as caught:
            await market.order(robot, [("/lift", 1.5)])
        assert_declined(caught.value, code="too-cheap")
    """
    __tracebackhide__ = True
    match error:
        case DemandDeclined():
            said = {one.code: one.detail for one in error.declines}
        case Declined():
            said = {error.reason: error.detail}
        case _:
            raise AssertionError(f"expected that a robot declines, but it is {type(error).__name__}: {error}")
    if code and code not in said:
        words = "; ".join(f"{reason} ({detail})" if detail else reason for reason, detail in said.items())
        raise AssertionError(f"expected a decline with the code {code}, but the robots said: {words}")


def judge(validator: Validator, outcome: RecordedOutcome) -> list[str]:
    """Why a validator would not let a job count, by its own checks and by the shipped policies but `complete`.

    It is empty if they hold. The validator need not run; `outcome` is what `run` and `Market.order` return.
    """
    messages = outcome.recording.messages
    evidence = Evidence(Liability.of_nobody(address=CONTRACT, promisor=ROBOT), keep=True)
    evidence._start_ns = min((message.log_time_ns for message in messages), default=0)
    checks = [policy.begin(evidence) for policy in validator.policies if policy != COMPLETE]
    for message in messages:
        judged = evidence.add(message, 0)
        for check in checks:
            check.add(judged)
    return [found.detail or found.name for check in checks for found in check.findings() if found.holds is not True]


def _reason(outcome: Outcome) -> str:
    return f"{outcome.reason or 'nothing says why'} [{outcome.code or 'no code'}]"


def _published(outcome: Outcome) -> str:
    if not isinstance(outcome, RecordedOutcome):
        return ""
    published = outcome.recording.published
    lines = [f"\n  {topic} {str(value)[:100]}" for topic, value in published[-10:]]
    return f"\nthe last of {len(published)} messages that it published:{''.join(lines)}" if lines else ""
