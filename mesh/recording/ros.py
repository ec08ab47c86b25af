"""Messages of ROS 1 and ROS 2 with their definitions, by the package rosbags (the extra `ros`).

`ros = RosTypes("humble")`, then `job.publish("/goal", ros.message("geometry_msgs/Twist", linear={"x": 1.0}))`; a
handler that takes `bytes` decodes them with `ros.decode("geometry_msgs/Twist", payload)`. `RosConverter` makes messages
of ROS 1 those of ROS 2 and the reverse; `ros_value` reads messages by the definitions that a recording has of them.

rosbags knows messages only. A service and an action are made of messages, as rosidl does it:
`my_robot/srv/Turn_Request`, `…_Response`, and of an action the goal, the result, the feedback and what its services and
its topic carry. The service itself is a type, too: its hash covers request, response and event.
"""

from __future__ import annotations

import re
import struct
from dataclasses import dataclass, fields, is_dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, Any, Final, TypeAlias

from mesh.base.extras import PackageMissing, needs_extra
from mesh.errors import InputError
from schemas.errors import InvalidPayload
from schemas.payloads import Payload, PayloadType

if TYPE_CHECKING:
    from collections.abc import Callable


Fields: TypeAlias = list[tuple[str, Any]]
Definitions: TypeAlias = dict[str, tuple[list[Any], Fields]]

LEGACY_TOPIC: Final = re.compile(r"/liability/eth_(0x[0-9A-Fa-f]{40})(/.+)", re.DOTALL)
"""A job's topic in a ROS graph and in the bags of the legacy network: the liability, and the topic as elsewhere."""


def legacy_topic(liability: str, topic: str) -> str:
    """The name of a job's topic that `LEGACY_TOPIC` matches."""
    return f"/liability/eth_{liability}{topic}"


_SEPARATOR: Final = re.compile(r"^---[ \t]*$", re.MULTILINE)


def interface_types(name: str, definition: str) -> Definitions:
    """The types in the text of a `.msg`, `.srv` or `.action` file, by the number of its parts.

    `name` is as in `std_msgs/msg/Header`; what stands for `msg` does not matter. Raises `TypesysError`, `ValueError`.
    """
    from rosbags.typesys import get_types_from_msg

    package, _, short = name.split("/", 2)
    parts = _SEPARATOR.split(definition)
    if len(parts) == 1:
        types: Definitions = get_types_from_msg(definition, f"{package}/msg/{short}")
        return {kind: (constants, fields or _no_fields()) for kind, (constants, fields) in types.items()}
    read = [_part(package, short, part) for part in parts]
    match read:
        case [request, response]:
            return _service(f"{package}/srv/{short}", request, response)
        case [goal, result, feedback]:
            return _action(f"{package}/action/{short}", goal, result, feedback)
    raise ValueError(f"it has {len(parts)} parts")


def described(store: Any, name: str, version: int) -> str:
    """The text of a type's definition and of those that it contains, for the schema of a recording."""
    if "/msg/" not in name:  # rosbags writes definitions of messages only
        store, name = _rewritten(store, name, _message_name), _message_name(name)
    definition, _ = store.generate_msgdef(name, ros_version=version)
    return str(definition)


def type_hash(store: Any, name: str) -> str:
    """The hash of a type of ROS 2 (RIHS01), as rosidl computes it. Raises `KeyError` for an unknown type."""
    return str(_rewritten(store, name, lambda kind: kind).hash_rihs01(name))


def _part(package: str, short: str, text: str) -> tuple[list[Any], Fields]:
    from rosbags.typesys import get_types_from_msg

    name = f"{package}/msg/{short}_Part"
    constants, fields = get_types_from_msg(text.strip("\n") + "\n", name)[name]
    return list(constants), list(fields) or _no_fields()


def _no_fields() -> Fields:
    """A message without fields is one byte in CDR, and has one field in hashes."""
    return [("structure_needs_at_least_one_member", _base("uint8"))]


def _base(name: str) -> Any:
    from rosbags.interfaces import Nodetype

    return Nodetype.BASE, (name, 0)


def _named(name: str) -> Any:
    from rosbags.interfaces import Nodetype

    return Nodetype.NAME, name


def _service(name: str, request: tuple[list[Any], Fields], response: tuple[list[Any], Fields]) -> Definitions:
    from rosbags.interfaces import Nodetype

    asked, answered, event = f"{name}_Request", f"{name}_Response", f"{name}_Event"
    at_most_one = {kind: (Nodetype.SEQUENCE, (_named(kind), 1)) for kind in (asked, answered)}
    info = _named("service_msgs/msg/ServiceEventInfo")
    whole = [("request_message", asked), ("response_message", answered), ("event_message", event)]
    return {
        asked: request,
        answered: response,
        event: ([], [("info", info), ("request", at_most_one[asked]), ("response", at_most_one[answered])]),
        name: ([], [(field, _named(kind)) for field, kind in whole]),
    }


def _action(
    name: str, goal: tuple[list[Any], Fields], result: tuple[list[Any], Fields], feedback: tuple[list[Any], Fields]
) -> Definitions:
    goal_id = ("goal_id", _named("unique_identifier_msgs/msg/UUID"))
    sent: Fields = [goal_id, ("goal", _named(f"{name}_Goal"))]
    accepted: Fields = [("accepted", _base("bool")), ("stamp", _named("builtin_interfaces/msg/Time"))]
    ended: Fields = [("status", _base("int8")), ("result", _named(f"{name}_Result"))]
    return {
        f"{name}_Goal": goal,
        f"{name}_Result": result,
        f"{name}_Feedback": feedback,
        f"{name}_FeedbackMessage": ([], [goal_id, ("feedback", _named(f"{name}_Feedback"))]),
        **_service(f"{name}_SendGoal", ([], sent), ([], accepted)),
        **_service(f"{name}_GetResult", ([], [goal_id]), ([], ended)),
    }


def _rewritten(store: Any, name: str, rename: Callable[[str], str]) -> Any:
    """A store with a type and all that it contains, renamed, with char as the uint8 that it is in ROS 2."""
    from rosbags.typesys.store import Typestore

    rewritten, left = Typestore(), [name]
    while left:
        kind = left.pop()
        if rename(kind) not in rewritten.fielddefs:
            constants, fields = store.fielddefs[kind]
            inner: Fields = [(field, _rewritten_node(node, rename, left)) for field, node in fields]
            rewritten.fielddefs[rename(kind)] = (constants, inner)
    return rewritten


def _rewritten_node(node: Any, rename: Callable[[str], str], found: list[str]) -> Any:
    """A field's type, rewritten. Adds the names in it to `found`."""
    from rosbags.interfaces import Nodetype

    kind, inner = node
    if kind == Nodetype.NAME:
        found.append(inner)
        return kind, rename(inner)
    if kind == Nodetype.BASE:
        return kind, ("uint8" if inner[0] == "char" else inner[0], inner[1])
    return kind, (_rewritten_node(inner[0], rename, found), inner[1])


def _message_name(name: str) -> str:
    return name.replace("/srv/", "/msg/").replace("/action/", "/msg/")


NOETIC: Final = "noetic"
NO_HASH: Final = "TypeHashNotSupported"
"""What stands for the hash of a type in distributions without hashes."""
WITHOUT_HASHES: Final = (NOETIC, "dashing", "eloquent", "foxy", "galactic", "humble")
_ZERO: Final = {"string": "", "bool": False, "float32": 0.0, "float64": 0.0}
_BYTES: Final = {"octet": "uint8", "byte": "uint8", "char": "uint8"}
"""Types whose arrays are bytes."""


class UnknownRosType(InputError, code="unknown-ros-type"):
    """A ROS type or distribution has no definition here, or its definition can't be read."""

    def __init__(self, name: str, why: str) -> None:
        super().__init__(f"{name}: {why}", hint="give the definition of an own type to `RosTypes.register`")
        self.name = name


class RosTypes:
    """The message types of a distribution: `noetic` (ROS 1), or `humble`, `jazzy`, … (ROS 2).

    Raises `PackageMissing` without rosbags, and `UnknownRosType` for another distribution.
    """

    def __init__(self, distribution: str) -> None:
        with needs_extra("ros", "ROS types"):
            from rosbags.typesys import Stores, get_typestore
        self._version = 1 if distribution == NOETIC else 2
        try:
            self._store = get_typestore(Stores[f"ROS{self._version}_{distribution.upper()}"])
        except KeyError:
            raise UnknownRosType(distribution, "no distribution of ROS that is known here") from None
        self.distribution: Final = distribution
        self._described: dict[str, PayloadType] = {}
        self._hashes: dict[str, str] = {}

    def register(self, name: str, definition: str) -> None:
        """Add an own type: the text of its `.msg` file, or the data of its schema in a recording.

        Of ROS 2 also the text of a `.srv` or `.action` file: its parts are messages with names such as
        `my_robot/srv/Turn_Request`. Raises `UnknownRosType` if the text can't be read.
        """
        from rosbags.typesys.base import TypesysError

        try:
            self._store.register(interface_types(full_ros_name(name), definition.removeprefix("\ufeff")))
        except (TypesysError, SyntaxError, ValueError) as error:
            raise UnknownRosType(name, f"its definition can't be read: {error}") from None

    def type_hash(self, name: str) -> str:
        """The hash of a message, service (`my_robot/srv/Turn`) or action's part that differs if the definition does.

        It is `TypeHashNotSupported` in distributions before Iron. Raises `UnknownRosType`.
        """
        self.type(name)
        if self.distribution in WITHOUT_HASHES:
            return NO_HASH
        if name not in self._hashes:
            try:
                self._hashes[name] = type_hash(self._store, full_ros_name(name))
            except KeyError as error:
                raise UnknownRosType(name, f"it contains {error}, of which there is no definition") from None
        return self._hashes[name]

    @property
    def is_ros2(self) -> bool:
        """Whether these are types of ROS 2."""
        return self._version == 2

    def knows(self, name: str) -> bool:
        """Whether there is a definition of a type."""
        return full_ros_name(name) in self._store.types

    def type(self, name: str) -> Any:
        """The class of a type, whose instances are messages. Raises `UnknownRosType`."""
        try:
            return self._store.types[full_ros_name(name)]
        except KeyError:
            raise UnknownRosType(name, "there is no such type") from None

    def message(self, name: str, /, **fields: Any) -> Payload:
        """A message of a type, encoded: a dict is a message in it, and a field that is not given is zero or empty.

        Raises `UnknownRosType`, `InvalidPayload`.
        """
        try:
            message = self._made(name, fields)
        except (TypeError, ValueError, OverflowError) as error:
            raise InvalidPayload(name, str(error)) from None
        return self.encode(message)

    def encode(self, message: Any) -> Payload:
        """A message, an instance of a class of `type`, encoded with its definition. Raises `InvalidPayload`."""
        from rosbags.serde import SerdeError

        name = str(message.__msgtype__)
        write = self._store.serialize_ros1 if self._version == 1 else self._store.serialize_cdr
        try:
            return Payload(bytes(write(message, name)), self.payload_type(name))
        except (SerdeError, struct.error, TypeError, ValueError, AttributeError) as error:
            raise InvalidPayload(name, str(error)) from None

    def decode(self, name: str, payload: bytes) -> Any:
        """The message in a payload of that type. Raises `UnknownRosType`, `InvalidPayload`."""
        from rosbags.serde import SerdeError

        self.type(name)
        read = self._store.deserialize_ros1 if self._version == 1 else self._store.deserialize_cdr
        try:
            return read(payload, full_ros_name(name))
        except (SerdeError, struct.error, ValueError, IndexError) as error:
            raise InvalidPayload(name, str(error)) from None

    def _made(self, name: str, fields: dict[str, Any]) -> Any:
        """A message with these fields, which may be dicts and lists."""
        kind = self.type(name)
        _, known = self._store.fielddefs[full_ros_name(name)]
        return kind(**fields | {field: self._value(node, fields.get(field)) for field, node in known})

    def _value(self, node: Any, value: Any) -> Any:
        """A field's value as rosbags takes it; None stands for what is not given."""
        from rosbags.interfaces import Nodetype

        match node:
            case Nodetype.NAME, str(name):
                return self._made(name, value or {}) if value is None or isinstance(value, dict) else value
            case Nodetype.BASE, (kind, _):
                return _ZERO.get(kind, 0) if value is None else value
            case _, ((Nodetype.BASE, (kind, _)), length) if kind != "string":
                from numpy import asarray, frombuffer

                dtype = _BYTES.get(kind, kind)
                if isinstance(value, bytes):
                    return frombuffer(value, dtype=dtype)
                return asarray([0] * length if value is None else value, dtype=dtype)
            case _, (inner, length):
                return [self._value(inner, one) for one in ([None] * length if value is None else value)]
        return value

    def payload_type(self, name: str) -> PayloadType:
        """The type of a message's payload, with its definition. Raises `UnknownRosType`."""
        self.type(name)
        name = full_ros_name(name)
        if name not in self._described:
            definition = described(self._store, name, self._version)
            kind, shown = ("ros1", name.replace("/msg/", "/")) if self._version == 1 else ("cdr", name)
            schema = "ros1msg" if self._version == 1 else "ros2msg"
            self._described[name] = PayloadType(kind, shown, schema, definition.encode())
        return self._described[name]


def full_ros_name(name: str) -> str:
    """The name that rosbags has for a type: `std_msgs/msg/Header` for `std_msgs/Header`."""
    if "/srv/" in name or "/action/" in name:
        return name
    package, _, kind = name.rpartition("/")
    return f"{package.removesuffix('/msg')}/msg/{kind}"


_HEADER: Final = "std_msgs/msg/Header"
_ENCODINGS: Final = {"ros1": 1, "cdr": 2}


@dataclass(frozen=True)
class RosConversion:
    """How messages of one type become those of another: its type, its definition's hash, and what converts a payload.

    `why` says why that is not possible; empty if it is.
    """

    type: PayloadType
    convert: Callable[[bytes], bytes] = bytes
    digest: str = ""
    why: str = ""


class RosConverter:
    """Converts types to ROS `version` 1 or 2; with version 0 they stay as they are, but get missing definitions.

    Types without a definition are those of the ROS `distribution`. Raises `PackageMissing` unless the version is 0.
    """

    def __init__(self, version: int, distribution: str) -> None:
        self._version = version
        self._known: dict[int, RosTypes | None] = {}
        self._distributions = {1: "noetic", 2: distribution}
        if version:
            with needs_extra("ros", "converting to another ROS format"):
                import rosbags.typesys  # noqa: F401
            self._types(2)

    def of(self, type: PayloadType) -> RosConversion:
        """How messages of a type are converted."""
        version = _ENCODINGS.get(type.encoding, 0)
        type = self._defined(type, version)
        if not self._version:
            return RosConversion(type)
        if not version:
            return RosConversion(type, why=f"its messages are {type.encoding or 'bytes'}, not of ROS")
        if not type.schema_data and not type.schema_name.endswith("/Empty"):
            return RosConversion(type, why=f"its type {type.schema_name} has no definition")
        if type.schema_encoding == "ros2idl":
            return RosConversion(type, why=f"its type {type.schema_name} is defined in IDL")
        if self._version == 1 and "/msg/" not in full_ros_name(type.schema_name):
            return RosConversion(type, why=f"{type.schema_name} is no type in ROS 1")
        try:
            return self._conversion(type, version)
        except Exception as error:  # of a stranger's definition
            return RosConversion(type, why=f"the definition of {type.schema_name} can't be read: {error}")

    def _conversion(self, type: PayloadType, version: int) -> RosConversion:
        from rosbags.typesys import Stores, get_typestore

        name, text = full_ros_name(type.schema_name), definition_text(type)
        headers = [get_typestore(each).fielddefs[_HEADER] for each in (Stores.ROS1_NOETIC, Stores.ROS2_JAZZY)]
        defined = _store(text, name, header=headers[self._version - 1])
        store = _store(text, name, header=headers[1])  # what converts payloads takes that of ROS 2
        if self._version == 2:
            text, digest = described(defined, name, 2), type_hash(defined, name)
        else:
            text, digest = defined.generate_msgdef(name, ros_version=1)
        if version == self._version:
            return RosConversion(type, digest=digest)
        if self._version == 2:
            changed = PayloadType("cdr", name, "ros2msg", text.encode())
            return RosConversion(changed, lambda payload: bytes(store.ros1_to_cdr(payload, name)), digest)
        changed = PayloadType("ros1", name.replace("/msg/", "/"), "ros1msg", text.encode())
        return RosConversion(changed, lambda payload: bytes(store.cdr_to_ros1(payload, name)), digest)

    def _defined(self, type: PayloadType, version: int) -> PayloadType:
        """The type with the definition that the distribution has for it, if it has none."""
        if type.schema_data or not version:
            return type
        types = self._types(version)
        try:
            return type if types is None else types.payload_type(type.schema_name)
        except UnknownRosType:
            return type

    def _types(self, version: int) -> RosTypes | None:
        """The types of the distribution; None without rosbags."""
        if version not in self._known:
            try:
                self._known[version] = RosTypes(self._distributions[version])
            except PackageMissing:
                self._known[version] = None
        return self._known[version]


def definition_text(type: PayloadType) -> str:
    """The definition of a ROS type, with plain line ends. ROS 1 allows any bytes in comments: they may be Latin-1."""
    try:
        text = type.schema_data.decode()
    except UnicodeDecodeError:
        text = type.schema_data.decode("latin-1")
    return text.replace("\r\n", "\n").replace("\r", "\n")


def _store(definition: str, name: str, *, header: Any = None) -> Any:
    """The types in a definition, in a store of their own; `header` takes the place of std_msgs/Header."""
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.EMPTY)
    found = get_types_from_msg(definition, _message_name(name))  # rosbags knows no others
    if header is not None:
        found[_HEADER] = header
    found[name] = found[_message_name(name)]
    store.register({each: defined for each, defined in found.items() if each not in store.fielddefs})
    return store


_LONGEST_MESSAGE: Final = 16 << 10
"""Bytes of the longest message that is decoded, which takes up to a fifth of a second. Images are longer."""

_NO_FIELDS: Final = ("__msgtype__", "structure_needs_at_least_one_member")


def ros_value(payload: bytes, kind: PayloadType) -> Any:
    """The message in a payload in CDR: a dict of its fields; the value alone if its only field is `data`.

    It is the payload if the type is not defined, or not readable, or the package rosbags is missing. Arrays of bytes
    are bytes.
    """
    if len(payload) > _LONGEST_MESSAGE or (store := _bounded_store(kind)) is None:
        return payload
    try:
        message = store.deserialize_cdr(payload, kind.schema_name)
        value = _plain(message)
    except Exception:  # the decoder is made from the definition, and may fail in any way
        return payload
    return value["data"] if isinstance(value, dict) and value.keys() == {"data"} else value


@lru_cache(maxsize=256)
def _bounded_store(kind: PayloadType) -> Any:
    """The types of a definition; None if there is none that can be read. 32 KiB of it take up to a second."""
    if kind.schema_encoding != "ros2msg" or not 0 < len(kind.schema_data) <= 32 << 10:
        return None
    try:
        store = _store(kind.schema_data.decode(), kind.schema_name)
        store.max_sequence_length = _LONGEST_MESSAGE
        store.get_msgdef(kind.schema_name)
    except Exception:  # of a stranger's text
        return None
    return store


def _plain(value: Any) -> Any:
    """A message of rosbags as values of Python."""
    if is_dataclass(value):
        return {
            field.name: _plain(getattr(value, field.name)) for field in fields(value) if field.name not in _NO_FIELDS
        }
    if hasattr(value, "tolist"):
        return value.tobytes() if value.dtype == "uint8" else value.tolist()
    if isinstance(value, list):
        return [_plain(member) for member in value]
    return value
