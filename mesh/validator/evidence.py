"""What policies see of a job: the messages of its recording and its objective, each decoded once for all policies."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

from mesh.evidence.clock_checks import ClockCheck, RecorderParts
from mesh.recording.ros_values import ros_value
from schemas.errors import InvalidPayload
from schemas.payloads import Empty, String, decode_value

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping

    from mesh.recording import Objective, Played
    from schemas import Liability
    from schemas.model import ModelDescription
    from schemas.payloads import PayloadType

MOST_KEPT: Final = 64 << 20
"""Bytes of messages that are kept in memory for own policies; of a larger file they are read again at each pass."""
LONGEST_JSON: Final = 4 << 20
"""Bytes of the longest JSON message that is decoded: as objects it takes twenty times as much."""
_COST: Final = 512
"""Bytes of memory that a message takes besides its payload."""
_VALUE_KEPT: Final = 4096
"""Bytes of the longest payload whose value is kept with the message."""
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
        if len(self.payload) <= _VALUE_KEPT:
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
        self._recording: Objective | None = None
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

    def open(self, recording: Objective) -> None:
        """Take the recording, whose messages follow."""
        self._recording, self._start_ns, self.metadata = recording, recording.start_ns, recording.metadata

    def add(self, message: Played, part: int) -> JudgedMessage:
        """Take the next message of the recording."""
        judged = JudgedMessage(message, part=part, start_ns=self._start_ns)
        if self._kept is not None:
            self._size += len(message.payload) + _COST
            self._kept.append(judged)
            if self._size > MOST_KEPT:
                self._kept = None
        return judged

    def open_objective(self, objective: Objective) -> None:
        """Take the objective."""
        self._objective = objective

    def _with_role(self, role: str) -> JudgedMessages:
        return JudgedMessages(lambda: (message for message in self._recorded() if message.role == role))

    def _recorded(self) -> Iterator[JudgedMessage]:
        if self._kept is not None or self._recording is None:
            return iter(self._kept or ())
        return self._read_again(self._recording)

    def _read_again(self, recording: Objective) -> Iterator[JudgedMessage]:
        clock = ClockCheck(RecorderParts.of(recording.metadata))
        for written in recording.in_file_order():
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
    if kind.encoding == "json" and len(payload) > LONGEST_JSON:
        return InvalidPayload("json", f"it has {len(payload)} bytes, more than are decoded")
    try:
        value = decode_value(payload, kind)
    except InvalidPayload as error:
        return error
    if isinstance(value, String):
        return value.data
    return None if isinstance(value, Empty) else value
