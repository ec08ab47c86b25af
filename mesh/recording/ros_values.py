"""The values of ROS 2 messages, by the definitions that a recording has of them.

Definitions and payloads may come from strangers: both are bounded, and what can't be decoded stays bytes.
"""

from __future__ import annotations

import re
from dataclasses import fields, is_dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, Any, Final

if TYPE_CHECKING:
    from schemas.payloads import PayloadType

_LONGEST_DEFINITION: Final = 32 << 10
"""Bytes of the longest definition that is read, which takes up to a second."""
_LONGEST_MESSAGE: Final = 16 << 10
"""Bytes of the longest message that is decoded, which takes up to a fifth of a second. Images are longer."""

_NO_FIELDS: Final = ("__msgtype__", "structure_needs_at_least_one_member")


def ros_value(payload: bytes, kind: PayloadType) -> Any:
    """The message in a payload in CDR: a dict of its fields; the value alone if its only field is `data`.

    It is the payload if the type is not defined, or not readable, or the package rosbags is missing. Arrays of bytes
    are bytes.
    """
    if len(payload) > _LONGEST_MESSAGE or (store := _store(kind)) is None:
        return payload
    try:
        message = store.deserialize_cdr(payload, kind.schema_name)
        value = _plain(message)
    except Exception:  # the decoder is made from the definition, and may fail in any way
        return payload
    return value["data"] if isinstance(value, dict) and value.keys() == {"data"} else value


@lru_cache(maxsize=256)
def _store(kind: PayloadType) -> Any:
    """The types of a definition; None if there is none that can be read."""
    if kind.schema_encoding != "ros2msg" or not 0 < len(kind.schema_data) <= _LONGEST_DEFINITION:
        return None
    try:
        from rosbags.typesys import Stores, get_types_from_msg, get_typestore

        store = get_typestore(Stores.EMPTY)
        store.max_sequence_length = _LONGEST_MESSAGE
        of_message = re.sub("/(srv|action)/", "/msg/", kind.schema_name)  # rosbags knows no others
        found = get_types_from_msg(kind.schema_data.decode(), of_message)
        found[kind.schema_name] = found[of_message]
        store.register({name: defined for name, defined in found.items() if name not in store.fielddefs})
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
