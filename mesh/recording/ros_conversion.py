"""Messages of ROS 1 as those of ROS 2 and the reverse, by the definitions of their types (package rosbags)."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

from mesh.extras import PackageMissing, needs_extra
from mesh.ros import RosTypes, UnknownRosType, full_ros_name
from mesh.ros_interfaces import described as definition_of
from mesh.ros_interfaces import type_hash
from schemas.payloads import PayloadType

if TYPE_CHECKING:
    from collections.abc import Callable

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
        name = full_ros_name(type.schema_name)
        described, store = _store(type, name, version=self._version), _store(type, name, version=2)
        if self._version == 2:
            text, digest = definition_of(described, name, 2), type_hash(described, name)
        else:
            text, digest = described.generate_msgdef(name, ros_version=1)
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


def _store(type: PayloadType, name: str, *, version: int) -> Any:
    """The types in a definition, with the header of a version of ROS. What converts payloads takes that of ROS 2."""
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    header = get_typestore(Stores.ROS1_NOETIC if version == 1 else Stores.ROS2_JAZZY).fielddefs[_HEADER]
    store = get_typestore(Stores.EMPTY)
    of_message = re.sub("/(srv|action)/", "/msg/", name)  # rosbags knows no others
    found = get_types_from_msg(type.schema_data.decode(), of_message) | {_HEADER: header}
    found[name] = found[of_message]
    store.register({each: defined for each, defined in found.items() if each not in store.fielddefs})
    return store
