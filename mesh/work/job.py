"""What handlers of topics receive: the job, and the messages that its objective plays."""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from typing import TYPE_CHECKING, Any, Final

import msgspec

from mesh.errors import AiraError, ClosedError, ConfigurationError
from mesh.network import sending
from mesh.recording import json_type
from schemas.agent_keys import LiabilityTopicKey
from schemas.errors import InvalidPayload
from schemas.payloads import JSON, PayloadType, decode_value, encode_value

if TYPE_CHECKING:
    import zenoh

    from mesh.recording import Played
    from schemas import Liability

ANY_TOPIC: Final = "*"
"""The topic of the handler for topics without a handler of their own."""


class JobFailed(AiraError, code="job-failed"):
    """Raise it in a handler to end the job without success, which refunds the promisee. The text says why."""


class DuplicateHandler(ConfigurationError, code="duplicate-handler"):
    """A topic has two handlers."""

    def __init__(self, topic: str) -> None:
        super().__init__(f"two handlers for topic {topic}", hint="give each topic one handler")
        self.topic = topic


class HandlerCancelled(AiraError, code="handler-cancelled"):
    """A handler ended because something that it waited for was cancelled, so it has not done its work."""


class Job:
    """The work for one liability, as its handlers see it."""

    def __init__(self, session: zenoh.Session, agent: str, liability: Liability, *, position: int = 0) -> None:
        self._session = session
        self._agent = agent
        self._types: dict[tuple[str, str], PayloadType] = {}
        self._subscriber: Any = None
        self.liability = liability
        """The contract that this job is for."""
        self.topics: frozenset[str] = frozenset()
        """The topics of its objective."""
        self.position = position
        """How many of the objective's messages have been handled."""
        self.playing: Played | None = None
        """The message that is being handled: its topic, times and type."""

    def publish(self, topic: str, message: object) -> None:
        """Publish on a topic of the job, as a device does. The message becomes part of the recording.

        `message` is `Empty`, `String`, a str, bytes, a msgspec Struct or plain JSON data. Raises `InvalidPayload` for
        anything else, and `ClosedError` before the job runs and after it has ended.
        """
        if self._subscriber is None:
            raise ClosedError(f"the job {self.liability.address} is not running")
        payload, kind = encode_value(message)
        key = str(LiabilityTopicKey(self._agent, self.liability.address, topic))
        if kind == JSON and isinstance(message, msgspec.Struct):
            kind = json_type(type(message))
            self._types[topic, kind.zenoh_encoding] = kind
        self._put(key, payload, kind)

    def _put(self, key: str, payload: bytes, kind: PayloadType) -> None:
        sending.put(self._session, key, payload, encoding=kind.zenoh_encoding)


TopicHandler = Callable[[Job, Any], Awaitable[object]]


class TopicHandlers:
    """The functions that handle what objectives play, by topic."""

    def __init__(self) -> None:
        self._handlers: dict[str, tuple[TopicHandler, type | None]] = {}

    def add(self, topic: str, handler: TopicHandler, kind: type | None = None) -> None:
        """Register the handler of a topic (`*`: of all others). Its messages are converted to `kind`.

        Raises `DuplicateHandler` for a second handler of the same topic.
        """
        if topic in self._handlers:
            raise DuplicateHandler(topic)
        self._handlers[topic] = (handler, kind)

    def __bool__(self) -> bool:
        return bool(self._handlers)

    @property
    def topics(self) -> frozenset[str] | None:
        """The topics that have a handler; None if any topic has one."""
        return None if ANY_TOPIC in self._handlers else frozenset(self._handlers)

    def obstacle(self, topic: str, value: Any) -> str:
        """Why the handler of a topic can't take a decoded message; empty if it can."""
        if (found := self._find(topic)) is not None:
            try:
                _converted(value, found[1])
            except InvalidPayload as error:
                return str(error)
        return ""

    async def handle(self, job: Job, message: Played) -> None:
        """Decode a played message and await its handler. Raises what the handler raises, and `JobFailed`."""
        found = self._find(message.topic)
        assert found is not None, "objectives with other topics are refused before they are played"
        handler, kind = found
        try:
            value = _converted(decode_value(message.payload, message.type), kind)
        except InvalidPayload as error:
            raise JobFailed(f"a message on {message.topic} is {error}") from None
        await handler(job, value)

    def _find(self, topic: str) -> tuple[TopicHandler, type | None] | None:
        return self._handlers.get(topic) or self._handlers.get(ANY_TOPIC)


def _converted(value: Any, kind: type | None) -> Any:
    """A decoded message as the type that its handler was registered for. Raises `InvalidPayload`."""
    if kind is None or isinstance(value, kind):
        return value
    try:
        return msgspec.convert(value, kind)
    except msgspec.ValidationError as error:
        raise InvalidPayload(kind.__name__, str(error)) from None
