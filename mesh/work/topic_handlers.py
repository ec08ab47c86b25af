"""The functions that handle what objectives play, and the types of the messages that they take."""

from __future__ import annotations

import inspect
import types
from contextlib import suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final, Union, get_args, get_origin, get_type_hints

import msgspec

from mesh.work.job import JobFailed
from mesh.work.registration import RegistrationError, call_handler, check_handler, name_of, user_frame
from schemas.agent_keys import topic_chunks
from schemas.errors import InvalidKey, InvalidPayload
from schemas.payloads import Empty, String, decode_value

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping

    from mesh.recording import Played
    from mesh.work.job import Job

    TopicHandler = Callable[[Job, Any], object]

ANY_TOPIC: Final = "*"
"""The topic of the handler for topics without a handler of their own."""
_NATIVE: Final = (Empty, String, bytes)
"""What payloads decode to, and no JSON is converted to."""
_ANYTHING: Final = (Any, object, inspect.Parameter.empty)


class DuplicateHandler(RegistrationError, code="duplicate-handler"):
    """A topic has two handlers."""

    def __init__(self, topic: str) -> None:
        super().__init__(f"two handlers for topic {topic}", hint="give each topic one handler")
        self.topic = topic


class InvalidTopic(RegistrationError, code="invalid-topic"):
    """A handler is registered for a text that is no topic."""

    def __init__(self, topic: object, why: str) -> None:
        super().__init__(f"{topic!r} is not a topic: {why}", hint='a topic is like "/blink"; "*" stands for all others')
        self.topic = topic


class InvalidMessageType(RegistrationError, code="invalid-message-type"):
    """No message can be decoded to the type that a handler declares."""

    def __init__(self, handler: str, why: str) -> None:
        hint = "use a msgspec Struct, a dataclass, float, int, bool, str, bytes, Empty, String, list or dict"
        super().__init__(f"the handler {handler} can't get messages: {why}", hint=hint)


@dataclass(frozen=True)
class MessageType:
    """The type of the messages that a handler takes: of its second argument, or given where it is registered.

    `declared` is that type, `Any` for messages of any type.
    """

    declared: Any
    _native: tuple[type, ...] = ()
    _converted: Any = None

    def convert(self, value: Any) -> Any:
        """A decoded message as this type. Raises `InvalidPayload`."""
        if self.declared is Any or isinstance(value, self._native):
            return value
        if self._converted is None or (isinstance(value, _NATIVE) and not isinstance(value, String)):
            raise InvalidPayload(_text(self.declared), f"it is {_described(value)}")
        plain = value.data if isinstance(value, String) else value
        try:
            return msgspec.convert(plain, self._converted)
        except msgspec.ValidationError as error:
            with suppress(msgspec.ValidationError):
                return msgspec.convert(_whole(plain), self._converted)
            raise InvalidPayload(_text(self.declared), str(error)) from None


@dataclass(frozen=True)
class _Registered:
    handler: TopicHandler
    type: MessageType


class TopicHandlers:
    """The functions that handle what objectives play, by topic."""

    def __init__(self) -> None:
        self._handlers: dict[str, _Registered] = {}

    def add(self, topic: str, handler: TopicHandler, kind: Any = None) -> None:
        """Register the handler of a topic (`*`: of all others).

        Its messages are converted to `kind`, by default the type that the handler's second argument has. Raises
        `InvalidTopic`, `DuplicateHandler`, `InvalidHandler` and `InvalidMessageType`.
        """
        check_topic(topic)
        if topic in self._handlers:
            raise DuplicateHandler(topic)
        check_handler(handler, "job: Job, message", arguments=2)
        declared = _declared(handler) if kind is None else kind
        self._handlers[topic] = _Registered(handler, _message_type(name_of(handler), declared))

    def __bool__(self) -> bool:
        return bool(self._handlers)

    @property
    def topics(self) -> frozenset[str] | None:
        """The topics that have a handler; None if any topic has one."""
        return None if ANY_TOPIC in self._handlers else frozenset(self._handlers)

    @property
    def declared(self) -> Mapping[str, Any]:
        """The type of messages that each topic's handler declares (`Any` if it declares none), in order."""
        return {topic: found.type.declared for topic, found in self._handlers.items()}

    def obstacle(self, topic: str, value: Any) -> str:
        """Why the handler of a topic can't take a decoded message; empty if it can."""
        if (found := self._find(topic)) is not None:
            try:
                found.type.convert(value)
            except InvalidPayload as error:
                return str(error)
        return ""

    async def handle(self, job: Job, message: Played) -> None:
        """Decode a played message and await its handler. Raises what the handler raises, and `JobFailed`."""
        found = self._find(message.topic)
        assert found is not None, "objectives with other topics are refused before they are played"
        try:
            value = found.type.convert(decode_value(message.payload, message.type))
        except InvalidPayload as error:
            raise JobFailed(f"a message on {message.topic} is {error}") from None
        await call_handler(found.handler, job, value)

    def _find(self, topic: str) -> _Registered | None:
        return self._handlers.get(topic) or self._handlers.get(ANY_TOPIC)


def check_topic(topic: object) -> None:
    """Raise `InvalidTopic` for what no handler can be registered for."""
    if not isinstance(topic, str):
        raise InvalidTopic(topic, "it is no text")
    if topic != ANY_TOPIC:
        try:
            topic_chunks(topic)
        except InvalidKey as error:
            raise InvalidTopic(topic, error.why) from None


def _declared(handler: Any) -> Any:
    """The type of a handler's second argument. Raises `InvalidMessageType` for an annotation that can't be read."""
    function = inspect.unwrap(getattr(handler, "func", handler))  # of a `partial`
    try:
        annotation = list(inspect.signature(handler).parameters.values())[1].annotation
    except (ValueError, IndexError):  # written in C, or with *args
        return Any
    source = getattr(function, "__globals__", None) or getattr(type(function).__call__, "__globals__", {})
    scope = {**user_frame().f_locals, **source}

    def holder() -> None: ...

    holder.__annotations__ = {"message": annotation}  # only this one: that of the job may be for type checkers only
    try:
        return get_type_hints(holder, scope, include_extras=True)["message"]
    except Exception as error:
        why = f"its annotation {annotation!r} can't be read ({error}); import the type outside of `if TYPE_CHECKING`"
        raise InvalidMessageType(name_of(handler), why) from None


def _message_type(handler: str, declared: Any) -> MessageType:
    """Raises `InvalidMessageType` for a type that no message can be decoded to."""
    if declared in _ANYTHING:
        return MessageType(Any)
    is_union = get_origin(declared) in (Union, types.UnionType)
    members = get_args(declared) if is_union else (declared,)
    native = tuple(one for one in members if one in _NATIVE)
    others = [one for one in members if one not in _NATIVE]
    converted = Union[tuple(others)] if others else None  # noqa: UP007
    try:
        unknown = next(_undecodable(msgspec.inspect.type_info(converted)), None) if others else None
    except (TypeError, NameError) as error:
        raise InvalidMessageType(handler, str(error)) from None
    if unknown is not None:
        raise InvalidMessageType(handler, f"no message can be decoded to {_text(unknown)}")
    return MessageType(declared, native, converted)


def _undecodable(info: msgspec.inspect.Type) -> Iterator[type]:
    """The types in a type that msgspec knows nothing of."""
    pending, seen = [info], set[int]()
    while pending:
        node = pending.pop()
        if id(node) in seen:
            continue
        seen.add(id(node))
        if isinstance(node, msgspec.inspect.CustomType):
            yield node.cls
        for value in msgspec.structs.astuple(node):
            for one in value if isinstance(value, tuple) else (value,):
                inner = one.type if isinstance(one, msgspec.inspect.Field) else one
                if isinstance(inner, msgspec.inspect.Type):
                    pending.append(inner)


def _whole(value: Any) -> Any:
    """Data with each float that is an integer as an int: for JSON Schema, 5.0 is an integer."""
    match value:
        case float() if value.is_integer():
            return int(value)
        case list():
            return [_whole(one) for one in value]
        case dict():
            return {name: _whole(one) for name, one in value.items()}
    return value


def _text(kind: Any) -> str:
    return kind.__name__ if isinstance(kind, type) else str(kind)


def _described(value: object) -> str:
    return f"{len(value)} bytes" if isinstance(value, bytes) else f"a {type(value).__name__}"
