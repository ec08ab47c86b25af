"""The policies that ship: what each demands of a recording, by its name."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from hashlib import blake2b
from itertools import chain
from types import MappingProxyType
from typing import TYPE_CHECKING, Final, NamedTuple

from mesh.evidence import Finding
from mesh.validator.policy import InvalidPolicy, Policy, PolicyCheck, PolicyOptions
from mesh.validator.schema_policy import SCHEMA

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping

    from mesh.validator.evidence import Evidence, JudgedMessage

_SECOND: Final = 10**9
_WITHIN: Final = _SECOND
_GAP: Final = 10 * _SECOND

COMPLETE: Final = Policy(
    "complete",
    "The recording is this job's, was made while the job ran, and shows that everything commanded was played.",
)
"""Is always applied: its findings are those of `mesh.evidence.verify`."""


@dataclass(frozen=True)
class Acknowledged(Policy):
    """Each command is answered by the device in time. The topics are empty for any."""

    command: str = ""
    answer: str = ""
    within_ns: int = _WITHIN

    @classmethod
    def of(cls, options: PolicyOptions) -> Acknowledged:
        """The policy with these options. Raises `InvalidPolicy`."""
        command, answer = options.text_of("command"), options.text_of("answer")
        within = options.time_of("within", _WITHIN)
        options.check_all_used("command", "answer", "within")
        by = f"on {answer}" if answer else "by the device"
        what = f"Each command{f' on {command}' if command else ''} is answered {by} within {within / _SECOND:g} s."
        return cls("acknowledged", what, command, answer, within)

    def begin(self, evidence: Evidence) -> PolicyCheck:
        """Begin to check a recording."""
        return _AnswerCheck(self)


class _Command(NamedTuple):
    """A command: when it was played, in nanoseconds and in seconds of the recording, and what identifies it."""

    time_ns: int
    time: float
    topic: str
    digest: bytes


class _AnswerCheck(PolicyCheck):
    """Waits for the answer to each command.

    A message on a named `answer` topic answers the command that has waited longest; the robot has the time for each, as
    it works on one after the other. Without a named topic, any message of the device answers all.
    A command that was open when the agent crashed is answered if it is played again, or by the first answer in time.
    """

    def __init__(self, policy: Acknowledged) -> None:
        self._policy = policy
        self._waiting: deque[_Command] = deque()
        self._interrupted: dict[bytes, list[_Command]] = {}
        """Commands that were open at a crash, by what identifies them."""
        self._part = 0
        self._last = self._answered = self._resumed = 0
        """When the last message came, when the last answer, and when the agent continued."""
        self._commands = self._unanswered = 0
        self._first: _Command | None = None

    def add(self, message: JudgedMessage) -> None:
        if message.part != self._part:
            self._expire(self._last)
            for command in self._waiting:
                self._interrupted.setdefault(command.digest, []).append(command)
            self._waiting.clear()
            self._part, self._resumed = message.part, message.time_ns
        self._last = message.time_ns
        if message.role == "objective" and self._policy.command in ("", message.topic):
            self._command(message)
        elif message.role == "device" and self._policy.answer in ("", message.topic):
            self._answer(message.time_ns)

    def findings(self) -> Iterator[Finding]:
        for command in (*chain.from_iterable(self._interrupted.values()), *self._waiting):
            self._miss(command)
        within = self._policy.within_ns / _SECOND
        if self._first is None:
            yield Finding("answers", True, f"{self._commands} commands, each answered within {within:g} s")
            return
        said = f"the command on {self._first.topic} at {self._first.time:.3f} s was not answered within {within:g} s"
        yield Finding("answers", False, f"{said}: {self._unanswered} of {self._commands} commands were not")

    def _command(self, message: JudgedMessage) -> None:
        self._expire(message.time_ns)
        digest = blake2b(message.topic.encode() + b"\0" + message.payload, digest_size=16).digest()
        self._commands += 1
        self._waiting.append(_Command(message.time_ns, message.time, message.topic, digest))
        if interrupted := self._interrupted.get(digest):
            interrupted.pop()

    def _answer(self, now: int) -> None:
        if now <= self._resumed + self._policy.within_ns:
            self._interrupted.clear()
        self._expire(now)
        if self._waiting and self._policy.answer:
            self._waiting.popleft()
        else:
            self._waiting.clear()
        self._answered = now

    def _expire(self, now: int) -> None:
        """Give up commands whose answers are overdue."""
        while self._waiting and max(self._waiting[0].time_ns, self._answered) + self._policy.within_ns < now:
            self._miss(self._waiting.popleft())

    def _miss(self, command: _Command) -> None:
        self._unanswered += 1
        self._first = self._first or command


@dataclass(frozen=True)
class RateBounds(Policy):
    """A topic of the device (empty: all of them together) has messages often enough, and not too often.

    `least` and `most` are messages per second, on average over the time in which the agent recorded; `gap_ns` is the
    longest time without one.
    """

    topic: str = ""
    least: float | None = None
    most: float | None = None
    gap_ns: int = _GAP

    @classmethod
    def of(cls, options: PolicyOptions) -> RateBounds:
        """The policy with these options. Raises `InvalidPolicy`."""
        topic, least, most = options.text_of("topic"), options.number_of("min"), options.number_of("max")
        gap = options.time_of("gap", _GAP)
        options.check_all_used("topic", "min", "max", "gap")
        if least is not None and most is not None and least > most:
            raise InvalidPolicy(options.text, "min is above max")
        bounds = [f"at {word} {bound:g} Hz" for word, bound in (("least", least), ("most", most)) if bound is not None]
        whose = f"on {topic}" if topic else "by the device"
        what = f"Messages {whose} are recorded {', '.join([*bounds, f'without a gap over {gap / _SECOND:g} s'])}."
        return cls("rate", what, topic, least, most, gap)

    def begin(self, evidence: Evidence) -> PolicyCheck:
        """Begin to check a recording."""
        return _RateCheck(self)


@dataclass
class _RateCheck(PolicyCheck):
    """Counts messages, and the time in which there could have been any: crashes are no gaps."""

    policy: RateBounds
    count: int = 0
    recorded_ns: int = 0
    longest: tuple[int, float] = (0, 0.0)
    """The longest gap in nanoseconds, and the time at which it began."""
    part: int = 0
    _last: JudgedMessage | None = None
    _heard: tuple[int, float] = (0, 0.0)
    """When the device was heard last, or the part was begun."""

    def add(self, message: JudgedMessage) -> None:
        if self._last is None or message.part != self.part:
            self._end_gap(self._last)
            self.part, self._heard = message.part, (message.time_ns, message.time)
        else:
            self.recorded_ns += message.time_ns - self._last.time_ns
        if message.role == "device" and self.policy.topic in ("", message.topic):
            self.count += 1
            self._end_gap(message)
            self._heard = message.time_ns, message.time
        self._last = message

    def findings(self) -> Iterator[Finding]:
        self._end_gap(self._last)
        where = f"on {self.policy.topic}" if self.policy.topic else "of the device"
        if not self.count:
            yield Finding("rate", False, f"there is no message {where}")
            return
        per_second = self.count / max(1.0, self.recorded_ns / _SECOND)
        said = f"{self.count} messages {where}, {per_second:.4g} per second"
        if self.policy.least is not None and per_second < self.policy.least:
            yield Finding("rate", False, f"{said}, and at least {self.policy.least:g} are required")
        elif self.policy.most is not None and per_second > self.policy.most:
            yield Finding("rate", False, f"{said}, and at most {self.policy.most:g} are allowed")
        else:
            yield Finding("rate", True, said)
        gap, since = self.longest[0] / _SECOND, self.longest[1]
        longest = f"the longest time without a message {where} is {gap:.4g} s, from {since:.3f} s on"
        yield Finding("gaps", self.longest[0] <= self.policy.gap_ns, longest)

    def _end_gap(self, message: JudgedMessage | None) -> None:
        """Note how long no message was heard, until this one."""
        if message is not None:
            self.longest = max(self.longest, (message.time_ns - self._heard[0], self._heard[1]))


_MAKERS: Final[Mapping[str, Callable[[PolicyOptions], Policy]]] = {
    "complete": lambda options: COMPLETE,
    "acknowledged": Acknowledged.of,
    "schema": lambda options: SCHEMA,
    "rate": RateBounds.of,
}


def policy_of(text: str) -> Policy:
    """A shipped policy by its name and options: `rate:topic=/imu:min=50:gap=500ms`. Raises `InvalidPolicy`."""
    options = PolicyOptions(text)
    make = _MAKERS.get(options.name)
    if make is None:
        raise InvalidPolicy(text, f"there is no policy {options.name!r}", hint=f"the policies are {', '.join(_MAKERS)}")
    policy = make(options)
    options.check_all_used()
    return policy


POLICIES: Final[Mapping[str, Policy]] = MappingProxyType({name: policy_of(name) for name in _MAKERS})
"""The shipped policies by their names, without options."""
