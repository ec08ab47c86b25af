"""Messages of ROS 1 and ROS 2 with their definitions, by the package rosbags (`pip install 'aira-mesh[ros]'`).

`ros = RosTypes("humble")`, then `job.publish("/goal", ros.message("geometry_msgs/Twist", linear={"x": 1.0}))`; a
handler that takes `bytes` decodes them with `ros.decode("geometry_msgs/Twist", payload)`.
"""

from __future__ import annotations

import struct
from typing import Any, Final

from mesh.errors import InputError
from mesh.extras import needs_extra
from mesh.ros_interfaces import described, interface_types, type_hash
from schemas.errors import InvalidPayload
from schemas.payloads import Payload, PayloadType

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
            self._store.register(interface_types(full_ros_name(name), definition))
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
