"""Judging a result: whether its recording proves that the work was done, by the policies of a validator.

A policy looks at the messages of a recording one after the other, each decoded once for all policies, and says what it
found. Some ship, and are named with options (`acknowledged:command=/lamp:within=2s`); a function of a user becomes one
with `Validator.check`. `Evidence` is what they see of a job. `judge` reads the recording once for all of them. Needs
neither a chain nor a network.
"""

from __future__ import annotations

import inspect
import logging
import math
import struct
import threading
from collections import defaultdict, deque
from concurrent.futures import Future, wait
from dataclasses import dataclass, field
from functools import lru_cache, partial
from hashlib import blake2b
from itertools import chain, islice
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import msgspec

from mesh.base.background import in_daemon_thread
from mesh.base.log_context import log_event
from mesh.errors import ConfigurationError, public_text
from mesh.recording import GENEROUS, Limits
from mesh.recording.ros import ros_value
from mesh.validator.verification import (
    NOT_IN_BAGS,
    Claim,
    ClockCheck,
    Faults,
    Finding,
    JobFiles,
    LegacyRecording,
    RecorderParts,
    RecordingObserver,
    read_result,
    verify,
)
from schemas import cid_of_file
from schemas.decoding import InvalidData, decode_json
from schemas.errors import InputError, InvalidPayload, InvalidRecord
from schemas.model import DESCRIPTION_LIMITS, Effort, ValueSchema
from schemas.payloads import RAW, plain_value
from schemas.signing import is_word
from schemas.verdicts import VERDICT_LIMITS, PolicyNote, ReportFinding

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
    from pathlib import Path
    from typing import TypeAlias

    from mesh.content import Progress
    from mesh.recording import Objective, Played
    from mesh.validator.verification import RecordedJob
    from schemas import Liability, Result
    from schemas.model import ModelDescription
    from schemas.payloads import PayloadType

    Outcome: TypeAlias = "bool | str | Finding | Iterable[Finding | str] | None"
    CheckFunction: TypeAlias = "Callable[[Evidence], Outcome]"

log = logging.getLogger(__name__)


class JudgingLimits(NamedTuple):
    """What the judging of a recording may use."""

    kept: int = 64 << 20
    """Bytes of messages that are kept in memory for own policies; of a larger file they are read again at each pass."""
    json: int = 4 << 20
    """Bytes of the longest JSON message that is decoded: as objects it takes twenty times as much."""
    values: int = 5_000_000
    """Values in arrays and objects of one recording that are checked, which takes about five seconds."""
    overdue: int = 4
    """Own checks that may go on after their time in one process; while there are so many, no other one is begun."""


JUDGING_LIMITS: Final = JudgingLimits()
_NOT_DECODED: Final = object()


class JudgedMessage:
    """A message of a recording or an objective, as policies get it.

    `topic`, `payload` and `type` are as they were sent. `time` is in seconds from the recording's first message (or the
    objective's), `time_ns` in nanoseconds of Unix time by the robot's clock. `role` is `objective` for what was
    commanded, `device` for what the device and the robot's handlers sent, `agent` for the agent's note. `part` counts
    the crashes before it, after which the agent continued.
    """

    __slots__ = ("_value", "part", "payload", "role", "time", "time_ns", "topic", "type")

    def __init__(self, message: Played, *, part: int, start_ns: int) -> None:
        self.topic: str = message.topic
        self.payload: bytes = message.payload
        self.type: PayloadType = message.type
        self.role: str = message.role
        self.part = part
        self.time_ns: int = message.log_time_ns
        self.time: float = (message.log_time_ns - start_ns) / 1e9
        self._value: Any = _NOT_DECODED

    @property
    def value(self) -> Any:
        """A number, a text, a list, None for an empty message, JSON data, a ROS 2 message as a dict.

        It is the payload if that is not of its type, or if the type can't be decoded here.
        """
        value = self.decoded()
        return self.payload if isinstance(value, InvalidPayload) else value

    def decoded(self) -> Any:
        """The `value`, but for a payload that is not of its type the `InvalidPayload` that says why."""
        if self._value is not _NOT_DECODED:
            return self._value
        value = _decode(self.payload, self.type)
        if len(self.payload) <= 4096:
            self._value = value
        return value

    def __repr__(self) -> str:
        return f"<{self.role or 'message'} {self.topic} at {self.time:.3f} s>"


class JudgedMessages:
    """Messages that can be iterated any number of times."""

    def __init__(self, read: Callable[[], Iterator[JudgedMessage]]) -> None:
        self._read = read

    def __iter__(self) -> Iterator[JudgedMessage]:
        return self._read()

    def on(self, topic: str) -> JudgedMessages:
        """Those on a topic."""
        return JudgedMessages(lambda: (message for message in self if message.topic == topic))


class Evidence:
    """A job as policies judge it: its contract, what was commanded, and what was recorded, in the order of time.

    `liability` is the contract, `model` the description of its model, if there is one, and `metadata` the metadata
    records of the recording by name. Messages of more than 64 MiB are read from the file again at each pass.
    """

    def __init__(self, liability: Liability, *, model: ModelDescription | None = None, keep: bool = False) -> None:
        self.liability: Final = liability
        self.model: Final = model
        self.metadata: Mapping[str, Mapping[str, str]] = {}
        self._recording: RecordedJob | None = None
        self._objective: Objective | None = None
        self._kept: list[JudgedMessage] | None = [] if keep else None
        self._size = 0
        self._start_ns = 0

    @property
    def messages(self) -> JudgedMessages:
        """All messages of the recording."""
        return JudgedMessages(self._recorded)

    @property
    def played(self) -> JudgedMessages:
        """The commands: messages of the objective that were played, some of them again after a crash."""
        return self._with_role("objective")

    @property
    def device(self) -> JudgedMessages:
        """What the device and the robot's handlers have sent."""
        return self._with_role("device")

    @property
    def objective(self) -> JudgedMessages:
        """The messages that were to be played, each at its time."""
        return JudgedMessages(self._due)

    def open(self, recording: RecordedJob) -> None:
        """Take the recording, whose messages follow."""
        self._recording, self._start_ns, self.metadata = recording, recording.start_ns, recording.metadata

    def add(self, message: Played, part: int) -> JudgedMessage:
        """Take the next message of the recording."""
        judged = JudgedMessage(message, part=part, start_ns=self._start_ns)
        if self._kept is not None:
            self._size += len(message.payload) + 512  # what a message takes besides its payload
            self._kept.append(judged)
            if self._size > JUDGING_LIMITS.kept:
                self._kept = None
        return judged

    def open_objective(self, objective: Objective) -> None:
        """Take the objective."""
        self._objective = objective

    def _with_role(self, role: str) -> JudgedMessages:
        return JudgedMessages(lambda: (message for message in self._recorded() if message.role == role))

    def _recorded(self) -> Iterator[JudgedMessage]:
        if self._kept is not None or self._recording is None:
            yield from self._kept or ()
            return
        clock = ClockCheck(RecorderParts.of(self._recording.metadata))
        for written in self._recording.in_file_order():
            message = written.message
            yield JudgedMessage(message, part=clock.add(message.log_time_ns), start_ns=self._start_ns)

    def _due(self) -> Iterator[JudgedMessage]:
        objective = self._objective
        if objective is not None:
            for message in objective.messages():
                yield JudgedMessage(message, part=0, start_ns=objective.start_ns)


def _decode(payload: bytes, kind: PayloadType) -> Any:
    if kind.encoding == "cdr":
        return ros_value(payload, kind)
    if kind.encoding == "json" and len(payload) > JUDGING_LIMITS.json:
        return InvalidPayload("json", f"it has {len(payload)} bytes, more than are decoded")
    try:
        return plain_value(payload, kind)
    except InvalidPayload as error:
        return error


CHECK_TIMEOUT: Final = "check-timeout"
"""The code of an own check that took too long: the work then neither counts nor fails."""


def invalid_policy(policy: str, why: str, *, hint: str = "") -> ConfigurationError:
    """The error of a policy (as it was given) with an unknown name or option, or a wrong value."""
    return ConfigurationError(f"the policy {policy!r}: {why}", hint=hint, code="invalid-policy")


class PolicyCheck:
    """A policy at work on one recording. This one demands nothing."""

    def add(self, message: JudgedMessage) -> None:
        """Look at the next message of the recording."""

    def findings(self) -> Iterator[Finding]:
        """What was found, once all messages are added. The work counts only if all of it holds."""
        yield from ()


def _demand_nothing(evidence: Evidence) -> PolicyCheck:
    return PolicyCheck()


@dataclass(frozen=True)
class Policy:
    """What a recording must show: `name` is a word for programs, `description` one sentence for people.

    `begin` begins to check a recording. Two policies are equal if they demand the same, as the description says.
    Raises `ConfigurationError` for a name or a description that can't be announced.
    """

    name: str
    description: str
    begin: Callable[[Evidence], PolicyCheck] = field(default=_demand_nothing, compare=False, repr=False)
    is_own: bool = False
    """Whether it is a function of a user."""

    def __post_init__(self) -> None:
        try:
            _ = self.note
        except InvalidRecord as error:
            raise invalid_policy(self.name, str(error)) from None

    @property
    def note(self) -> PolicyNote:
        """The policy as its validator announces it."""
        return PolicyNote(name=self.name, description=self.description)


class PolicyOptions:
    """The options of a policy, as written after its name: `acknowledged:command=/lamp:within=2s`."""

    def __init__(self, text: str) -> None:
        self.text: Final = text
        self.name, *options = text.strip().split(":")
        pairs = [option.partition("=") for option in options]
        if not all(name and equals and value for name, equals, value in pairs):
            raise invalid_policy(text, "options are written name=value", hint=f"for example {self.name}:within=2s")
        self._values = {name: value for name, _, value in pairs}
        if len(self._values) < len(pairs):
            raise invalid_policy(text, "an option is given twice")
        self._known: list[str] = []

    def text_of(self, name: str) -> str:
        """A text; empty if it is not given."""
        self._known.append(name)
        return self._values.pop(name, "")

    def number_of(self, name: str) -> float | None:
        """A positive number; None if it is not given."""
        if not (value := self.text_of(name)):
            return None
        try:
            number = float(value)
        except ValueError:
            number = 0.0
        if not 0 < number < math.inf:
            raise invalid_policy(self.text, f"{name} must be a positive number, not {value!r}")
        return number

    def time_of(self, name: str, default_ns: int) -> int:
        """A time in nanoseconds, written with its unit: 500ms, 1s, 2m, 1h."""
        if not (value := self.text_of(name)):
            return default_ns
        for unit, factor in (("ms", 10**6), ("s", 10**9), ("m", 60 * 10**9), ("h", 3600 * 10**9)):
            amount = value.removesuffix(unit)
            if amount != value and amount.replace(".", "", 1).isdecimal() and 0 < float(amount) < 10**6:
                return round(float(amount) * factor)
        raise invalid_policy(self.text, f"{name} must be a time such as 500ms, 1s or 2m, not {value!r}")

    def check_all_used(self) -> None:
        """Raise `ConfigurationError` if there are other options than those that were asked for."""
        if self._values:
            known = self._known
            name, hint = min(self._values), f"its options: {', '.join(known)}" if known else "it has no options"
            raise invalid_policy(self.text, f"it has no option {name!r}", hint=hint)


def own_policy(name: str, description: str, function: CheckFunction, timeout: float = 60.0) -> Policy:
    """A policy by a function of a user, which gets the `Evidence` and says whether it holds.

    It returns True or an empty text if it holds, False or a text that says why if it does not, None if it can't decide
    (then the work does not count), or yields `Finding`s and texts. An exception also counts as undecided. If it takes
    more than `timeout` seconds, the result is not judged, unless another finding fails. Raises `ConfigurationError`.
    """
    if not 0 < timeout <= threading.TIMEOUT_MAX:
        raise invalid_policy(name, f"its timeout must be a positive number of seconds, not {timeout}")
    if inspect.iscoroutinefunction(function):
        raise invalid_policy(name, "a check is a plain function, which runs in a thread")
    return Policy(name, description, partial(_OwnCheck, name, description, function, timeout), is_own=True)


_overdue: Final[set[Future[list[Finding]]]] = set()
"""The checks that go on after their time."""


class _OwnCheck(PolicyCheck):
    def __init__(
        self, name: str, description: str, function: CheckFunction, timeout: float, evidence: Evidence
    ) -> None:
        self._name = name
        self._description = description
        self._function = function
        self._timeout = timeout
        self._evidence = evidence

    def findings(self) -> Iterator[Finding]:
        """What the function finds in time.

        Nothing can stop a thread from outside: a function whose time is over goes on, and their number is bounded.
        """
        _overdue.difference_update([check for check in tuple(_overdue) if check.done()])
        if len(_overdue) >= JUDGING_LIMITS.overdue:
            yield Finding(CHECK_TIMEOUT, None, f"it was not begun: {len(_overdue)} earlier checks have not ended")
            return
        check = in_daemon_thread(
            lambda: list(_findings_of(self._function(self._evidence), self._description)), f"check {self._name}"
        )
        wait([check], self._timeout)
        if not check.done():
            _overdue.add(check)
            yield Finding(CHECK_TIMEOUT, None, f"it did not end within {self._timeout:g} s")
            return
        try:
            yield from check.result()
        except (Exception, SystemExit) as error:  # of a user's function
            facts = log_event("policy-check-failed", policy=self._name)
            log.exception("the check of the policy %s failed", self._name, extra=facts)
            said = f"{type(error).__name__}: {public_text(error)}" if str(error) else type(error).__name__
            yield Finding("check-failed", None, said)


def _findings_of(outcome: Outcome, description: str) -> Iterator[Finding]:
    """The findings in what a user's function returns, or yields: at most as many as a report holds."""
    match outcome:
        case True | "":
            yield Finding("check", True, description)
        case False:
            yield Finding("check", False, f"it does not hold: {description}")
        case None:
            yield Finding("check", None, "the check did not decide")
        case str():
            yield Finding("check", False, outcome)
        case Finding():
            yield outcome
        case _:
            found = list(islice(outcome, VERDICT_LIMITS.findings))
            for one in found:
                yield one if isinstance(one, Finding) else Finding("check", False, str(one))
            if not found:
                yield Finding("check", True, description)


_NUMBERS: Final = frozenset({"minimum", "maximum", "exclusiveMinimum", "exclusiveMaximum"})
_OF_TYPE: Final = {
    "null": frozenset[str](),
    "boolean": frozenset[str](),
    "integer": _NUMBERS | {"enum"},
    "number": _NUMBERS,
    "string": frozenset({"enum", "minLength", "maxLength"}),
    "array": frozenset({"minItems", "maxItems"}),
    "object": frozenset[str](),
}
"""The keywords of JSON Schema that are checked, by type, besides `items`, `properties` and `required`."""


class _SchemaCheck(PolicyCheck):
    """Whether each message of the device fits its type, its JSON Schema and what the model says of results."""

    def __init__(self, evidence: Evidence) -> None:
        self._model = evidence.model
        self._faults: defaultdict[str, Faults] = defaultdict(Faults)
        self._heard: set[str] = set()
        self._effort = Effort(JUDGING_LIMITS.values)
        self._count = 0

    def add(self, message: JudgedMessage) -> None:
        if message.role != "device":
            return
        self._count += 1
        self._heard.add(message.topic)
        try:
            found = self._fault(message)
        except InputError as error:
            found = "limits", str(error)
        except RecursionError:
            found = "types", "it is nested too deep"
        if found is not None:
            name, why = found
            self._faults[name].add(f"a message on {message.topic} at {message.time:.3f} s: {why}")

    def findings(self) -> Iterator[Finding]:
        faults = self._faults
        yield faults["types"].finding("types", f"all {self._count} messages of the device are of their types")
        yield faults["finite"].finding("finite", "all numbers are finite")
        yield faults["limits"].finding("limits", "all values are within the limits of their schemas")
        if self._model is not None:
            missing = [one.topic for one in self._model.result if one.required and one.topic not in self._heard]
            if missing and not faults["model"].count:
                faults["model"].add(f"there is no message on {missing[0]}, which the model requires")
            yield faults["model"].finding("model", "the messages are as the model describes results")

    def _fault(self, message: JudgedMessage) -> tuple[str, str] | None:
        """The kind of a message's first fault, and why; None if it has none."""
        value, kind = message.decoded(), message.type
        if isinstance(value, InvalidPayload):
            return "types", str(value)
        if isinstance(value, bytes) and kind.encoding != RAW.encoding:
            return "types", f"its type {kind.zenoh_encoding[:80]!r} can't be decoded"
        if not _is_finite(value, self._effort):
            return "finite", "a number is infinite or not a number"
        schema = _json_schema(kind)
        if schema is not None and (why := schema.fault(value, effort=self._effort)):
            return "limits", why
        results = () if self._model is None else self._model.result
        described = next((one for one in results if one.topic == message.topic), None)
        if described is not None and (why := described.fault(kind, value, self._effort)):
            return "model", why
        return None


def _is_finite(value: Any, effort: Effort) -> bool:
    match value:
        case float():
            return math.isfinite(value)
        case list():
            effort.spend(len(value))
            return all(_is_finite(member, effort) for member in value)
        case dict():
            effort.spend(len(value))
            return all(_is_finite(member, effort) for member in value.values())
    return True


@lru_cache(maxsize=256)
def _json_schema(kind: PayloadType) -> ValueSchema | None:
    """The schema of JSON messages, as far as it is understood; None if it says nothing."""
    if kind.encoding != "json" or kind.schema_encoding != "jsonschema" or len(kind.schema_data) > (64 << 10):
        return None
    try:
        return msgspec.convert(_understood(decode_json(kind.schema_data)), ValueSchema)
    except (InvalidData, msgspec.ValidationError, ValueError, TypeError):
        return None


def _understood(schema: Any, depth: int = DESCRIPTION_LIMITS.depth) -> dict[str, Any]:
    """The keywords of a JSON Schema that `ValueSchema` has; what is nested too deep fits any value."""
    kind = schema.get("type") if isinstance(schema, dict) else None
    if not isinstance(kind, str) or kind not in _OF_TYPE:
        return {}
    found = {name: schema[name] for name in _OF_TYPE[kind] if name in schema}
    if depth > 1 and kind == "array" and "items" in schema:
        found["items"] = _understood(schema["items"], depth - 1)
    if depth > 1 and kind == "object" and isinstance(schema.get("properties"), dict):
        found["properties"] = {name: _understood(one, depth - 1) for name, one in schema["properties"].items()}
        found["required"] = [name for name in schema.get("required", ()) if name in found["properties"]]
    return {"type": kind, **found}


def _acknowledged(options: PolicyOptions) -> Policy:
    """Each command is answered by the device in time. The topics are empty for any."""
    command, answer = options.text_of("command"), options.text_of("answer")
    within = options.time_of("within", 10**9)
    by = f"on {answer}" if answer else "by the device"
    what = f"Each command{f' on {command}' if command else ''} is answered {by} within {within / 10**9:g} s."
    return Policy("acknowledged", what, lambda evidence: _AnswerCheck(command, answer, within))


class _Command(NamedTuple):
    """A command: when it was played, in nanoseconds and in seconds of the recording, and what identifies it."""

    time_ns: int
    time: float
    topic: str
    digest: bytes


class _AnswerCheck(PolicyCheck):
    """Waits for the answer to each command, for `within` nanoseconds.

    A message on a named `answer` topic answers the command that has waited longest; the robot has the time for each, as
    it works on one after the other. Without a named topic, any message of the device answers all.
    A command that was open when the agent crashed is answered if it is played again, or by the first answer in time.
    """

    def __init__(self, command: str, answer: str, within: int) -> None:
        self._command_topic, self._answer_topic, self._within = command, answer, within
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
        if message.role == "objective" and self._command_topic in ("", message.topic):
            self._command(message)
        elif message.role == "device" and self._answer_topic in ("", message.topic):
            self._answer(message.time_ns)

    def findings(self) -> Iterator[Finding]:
        for command in (*chain.from_iterable(self._interrupted.values()), *self._waiting):
            self._miss(command)
        within = self._within / 10**9
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
        if now <= self._resumed + self._within:
            self._interrupted.clear()
        self._expire(now)
        if self._waiting and self._answer_topic:
            self._waiting.popleft()
        else:
            self._waiting.clear()
        self._answered = now

    def _expire(self, now: int) -> None:
        """Give up commands whose answers are overdue."""
        while self._waiting and max(self._waiting[0].time_ns, self._answered) + self._within < now:
            self._miss(self._waiting.popleft())

    def _miss(self, command: _Command) -> None:
        self._unanswered += 1
        self._first = self._first or command


def _rate(options: PolicyOptions) -> Policy:
    """A topic of the device (empty: all of them together) has messages often enough, and not too often."""
    topic, least, most = options.text_of("topic"), options.number_of("min"), options.number_of("max")
    gap = options.time_of("gap", 10 * 10**9)
    if least is not None and most is not None and least > most:
        raise invalid_policy(options.text, "min is above max")
    bounds = [f"at {word} {bound:g} Hz" for word, bound in (("least", least), ("most", most)) if bound is not None]
    whose = f"on {topic}" if topic else "by the device"
    what = f"Messages {whose} are recorded {', '.join([*bounds, f'without a gap over {gap / 10**9:g} s'])}."
    return Policy("rate", what, lambda evidence: _RateCheck(topic, least, most, gap))


@dataclass
class _RateCheck(PolicyCheck):
    """Counts messages, and the time in which there could have been any: crashes are no gaps.

    `least` and `most` are messages per second, on average over the time in which the agent recorded; `gap_ns` is the
    longest time without one.
    """

    topic: str
    least: float | None
    most: float | None
    gap_ns: int
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
        if message.role == "device" and self.topic in ("", message.topic):
            self.count += 1
            self._end_gap(message)
            self._heard = message.time_ns, message.time
        self._last = message

    def findings(self) -> Iterator[Finding]:
        self._end_gap(self._last)
        where = f"on {self.topic}" if self.topic else "of the device"
        if not self.count:
            yield Finding("rate", False, f"there is no message {where}")
            return
        per_second = self.count / max(1.0, self.recorded_ns / 10**9)
        said = f"{self.count} messages {where}, {per_second:.4g} per second"
        if self.least is not None and per_second < self.least:
            yield Finding("rate", False, f"{said}, and at least {self.least:g} are required")
        elif self.most is not None and per_second > self.most:
            yield Finding("rate", False, f"{said}, and at most {self.most:g} are allowed")
        else:
            yield Finding("rate", True, said)
        gap, since = self.longest[0] / 10**9, self.longest[1]
        longest = f"the longest time without a message {where} is {gap:.4g} s, from {since:.3f} s on"
        yield Finding("gaps", self.longest[0] <= self.gap_ns, longest)

    def _end_gap(self, message: JudgedMessage | None) -> None:
        """Note how long no message was heard, until this one."""
        if message is not None:
            self.longest = max(self.longest, (message.time_ns - self._heard[0], self._heard[1]))


COMPLETE: Final = Policy(
    "complete",
    "The recording is this job's, was made while the job ran, and shows that everything commanded was played.",
)
"""Is always applied: its findings are those of `mesh.validator.verification.verify`."""
_SCHEMA: Final = Policy(
    "schema",
    "Each message of the device is of its declared type, its numbers are finite, and within the limits of its schema "
    "and of the model.",
    _SchemaCheck,
)
_MAKERS: Final[Mapping[str, Callable[[PolicyOptions], Policy]]] = {
    "complete": lambda options: COMPLETE,
    "acknowledged": _acknowledged,
    "schema": lambda options: _SCHEMA,
    "rate": _rate,
}


def policy_of(text: str) -> Policy:
    """A shipped policy by its name and options: `rate:topic=/imu:min=50:gap=500ms`. Raises `ConfigurationError`."""
    options = PolicyOptions(text)
    if (make := _MAKERS.get(options.name)) is None:
        hint = f"the policies are {', '.join(_MAKERS)}"
        raise invalid_policy(text, f"there is no policy {options.name!r}", hint=hint)
    policy = make(options)
    options.check_all_used()
    return policy


POLICIES: Final[Mapping[str, Policy]] = MappingProxyType({name: policy_of(name) for name in _MAKERS})
"""The shipped policies by their names, without options."""


_LIMITS: Final = Limits()
_NOT_JUDGED: Final = frozenset({"finalized"})
"""Findings of `verify` that are not about the result: a validator judges before the contract has ended."""
_MAY_STAY_OPEN: Final = frozenset({"closed", CHECK_TIMEOUT})
"""Findings that may stay undecided: that an agent crashed, and may have lost a second of the recording, is no fault of
the robot, and neither is a check that takes too long."""
_INTERVAL: Final = struct.Struct("<Q")
_DISTINCT: Final = 8
"""Different times between messages without which a recording has no hash."""


@dataclass(frozen=True, kw_only=True)
class Case:
    """A Result to be judged.

    `message` is the promisor's encoded Result, which claims success if `claimed`. The recording must have been made
    between `since_ns` and `until_ns`, in nanoseconds of Unix time by the robot's clock: allow for wrong clocks.
    `owner_of` returns the address of another liability for which a recording with that mark (see `Judgement`) was
    judged a success; empty if there is none. `model` is the description of the liability's model, if it has one.

    Give the CIDs by which the files were fetched: one that was made with other settings than ours can't be computed.
    """

    liability: Liability
    claimed: bool
    message: bytes
    since_ns: int
    until_ns: int
    owner_of: Callable[[str], str]
    model: ModelDescription | None = None
    objective_cid: str = ""
    recording_cid: str = ""


@dataclass(frozen=True, kw_only=True)
class Judgement:
    """Whether a result counts, and all that was found: the work counts only if it is claimed and every finding holds.

    If an own check took too long and nothing else fails, the result is not judged: `is_decided` is false.

    `marks` identify the recording, so that it pays only one job: the CID of the file, and a hash of the times between
    its messages, to the nanosecond, which stays if names, values and the time of day are changed. A recording with few
    messages has no hash, as another one might have the same.
    """

    success: bool
    findings: tuple[ReportFinding, ...]
    marks: tuple[str, ...] = ()

    @property
    def failures(self) -> tuple[ReportFinding, ...]:
        """The findings because of which the work does not count."""
        return tuple(finding for finding in self.findings if finding.holds is False)

    @property
    def overdue(self) -> tuple[str, ...]:
        """The policies whose checks took too long."""
        return tuple(one.policy for one in self.findings if one.code == CHECK_TIMEOUT and one.holds is None)

    @property
    def is_decided(self) -> bool:
        """Whether a verdict can be signed."""
        return self.success or bool(self.failures)


def judge(
    case: Case,
    *,
    objective: Path,
    recording: Path,
    policies: Sequence[Policy],
    bags: bool = False,
    limits: Limits = _LIMITS,
) -> Judgement:
    """Judge a result by `complete` and the `policies`. Files beyond the `limits` are not readable.

    With `bags` the recording may be a bag of the legacy software, of which less can be checked.

    Use a thread. Raises `OSError` if a file can't be read; whatever is in the files is a finding.
    """
    trial = _Trial(case.liability, case.model, policies)
    cid = case.recording_cid or cid_of_file(recording)
    signed = read_result(case.message)
    claimed = None if isinstance(signed, str) else signed.message
    claim = Claim.of_contract(case.liability)
    complete, own = trial.run(
        msgspec.structs.replace(claim, result=claimed.result if claimed else "", success=case.claimed, finalized=None),
        JobFiles(
            objective=objective,
            result=recording,
            message=case.message,
            objective_cid=case.objective_cid,
            result_cid=cid,
            period=(case.since_ns, case.until_ns),
        ),
        bags=bags,
        limits=limits,
    )
    found = [_check_claimed(case, claimed)]
    found += [one if trial.is_legacy and one.name in NOT_IN_BAGS else _decided(one) for one in complete]
    marks = trial.marks(cid)
    found.append(_check_replayed(case, marks))
    reported = [_reported(COMPLETE.name, finding) for finding in found]
    reported += [_reported(policy, _decided(finding)) for policy, finding in own]
    holds = all(one.holds is not False and (one.code != CHECK_TIMEOUT or one.holds) for one in reported)
    return Judgement(success=case.claimed and holds, findings=_bounded(reported), marks=marks)


def examine(
    liability: Liability,
    files: JobFiles,
    *,
    policies: Sequence[Policy],
    model: ModelDescription | None = None,
    bags: bool = False,
    progress: Progress | None = None,
) -> tuple[ReportFinding, ...]:
    """What a validator would find in a recording that nobody has handed in: `aira validator check`.

    The `liability` is what own checks get. Findings for which there is nothing to compare with stay undecided. Use a
    thread. Raises `OSError` if a file can't be read.
    """
    trial = _Trial(liability, model, policies)
    complete, own = trial.run(Claim(), files, bags=bags, progress=progress)
    found = [*((COMPLETE.name, finding) for finding in complete), *own]
    return tuple(_reported(policy, finding) for policy, finding in found)


class _Trial(RecordingObserver):
    """Shows the recording to all policies while it is verified, and computes its hash."""

    def __init__(self, liability: Liability, model: ModelDescription | None, policies: Sequence[Policy]) -> None:
        self._evidence = Evidence(liability, model=model, keep=any(policy.is_own for policy in policies))
        self._policies = policies
        self._checks: list[PolicyCheck] = []
        self._hash = blake2b(digest_size=32)
        self._intervals: set[int] = set()
        self._last = 0
        self.is_legacy = False
        """Whether it is a bag of the legacy software, in which most findings of `verify` stay undecided."""

    def run(
        self, claim: Claim, files: JobFiles, *, bags: bool, limits: Limits = GENEROUS, progress: Progress | None = None
    ) -> tuple[list[Finding], list[tuple[str, Finding]]]:
        """What `verify` and then the policies find in the files.

        A recording that they can't deal with proves nothing, which is a finding: if it raised an error, its maker
        could keep the validator from judging. Raises `OSError` if a file can't be read.
        """
        try:
            verdict = verify(claim, files, bags=bags, limits=limits, observer=self, progress=progress)
            found = [one for one in verdict.findings if one.name not in _NOT_JUDGED]
            # Without a readable recording no check was begun.
            pairs = zip(self._policies, self._checks, strict=False)
            return found, [(policy.name, one) for policy, check in pairs for one in check.findings()]
        except OSError:
            raise
        except Exception as error:
            log.exception("a recording can't be judged", extra=log_event("judging-impossible"))
            return [Finding("readable", False, f"the recording can't be judged ({type(error).__name__})")], []

    def open(self, recording: RecordedJob) -> None:
        self.is_legacy = isinstance(recording, LegacyRecording)
        self._evidence.open(recording)
        self._checks = [policy.begin(self._evidence) for policy in self._policies]
        self._last = recording.start_ns

    def add(self, message: Played, part: int) -> None:
        judged = self._evidence.add(message, part)
        for check in self._checks:
            check.add(judged)
        since, self._last = message.log_time_ns - self._last, message.log_time_ns
        self._hash.update(_INTERVAL.pack(since % (1 << 64)))
        if len(self._intervals) < _DISTINCT:
            self._intervals.add(since)

    def open_objective(self, objective: Objective) -> None:
        self._evidence.open_objective(objective)

    def marks(self, cid: str) -> tuple[str, ...]:
        return (cid, self._hash.hexdigest()) if len(self._intervals) == _DISTINCT else (cid,)


def _check_claimed(case: Case, signed: Result | None) -> Finding:
    if not case.claimed:
        return Finding("claimed", False, "the promisor does not claim success")
    if signed is not None and not signed.success:
        return Finding("claimed", False, "the promisor has signed that it had no success")
    return Finding("claimed", True, "the promisor claims success")


def _check_replayed(case: Case, marks: Sequence[str]) -> Finding:
    for mark in marks:
        if owner := case.owner_of(mark):
            return Finding("replayed", False, f"these messages were the result of another liability, {owner}")
    return Finding("replayed", True, "no other liability had these messages as its result")


def _decided(finding: Finding) -> Finding:
    """The finding, as a failure if it is undecided and must not be."""
    if finding.holds is None and finding.name not in _MAY_STAY_OPEN:
        return Finding(finding.name, False, finding.detail)
    return finding


def _reported(policy: str, finding: Finding) -> ReportFinding:
    """A finding for the report. Its texts may be those of strangers, or of a user's check."""
    code = finding.name if is_word(finding.name) else "check"
    return ReportFinding(policy=policy, code=code, holds=finding.holds, detail=_line(str(finding.detail)))


def _line(text: str) -> str:
    """At most `VERDICT_LIMITS.text` characters of a text that a terminal shows as they are."""
    shown = "".join(letter if letter.isprintable() else " " for letter in text[: VERDICT_LIMITS.text + 1])
    return shown if len(shown) <= VERDICT_LIMITS.text else shown[: VERDICT_LIMITS.text - 1] + "…"


def _bounded(findings: Sequence[ReportFinding]) -> tuple[ReportFinding, ...]:
    """As many findings as a report holds, in their order; failures come before others if there are too many."""
    kept, size = set[int](), 0
    for number in sorted(range(len(findings)), key=lambda number: findings[number].holds is not False):
        size += len(findings[number].encode()) + 1
        if len(kept) < VERDICT_LIMITS.findings and size <= VERDICT_LIMITS.size - 4096:  # for the rest of the report
            kept.add(number)
    return tuple(finding for number, finding in enumerate(findings) if number in kept)
