"""The definition of a payload's type, which travels in the attachment of some of a topic's messages.

Zenoh's encoding has only the name of a type. An attachment with a definition is the sender's mark (a line), the
encoding of the schema (a line), and the schema.
"""

from __future__ import annotations

from typing import Final

from schemas.payloads import PayloadType

REPEAT_SECONDS: Final = 5.0
"""Seconds after which a definition travels again: what carried it may be lost, and listeners come later."""
LONGEST_DEFINITION: Final = 64 << 10
"""Bytes of the longest definition that travels."""
REMEMBERED_TOPICS: Final = 4096
_SCHEMA_ENCODINGS: Final = frozenset({"ros1msg", "ros2msg", "ros2idl", "jsonschema", "protobuf"})


def with_definition(mark: bytes, type: PayloadType) -> bytes:
    """An attachment with a sender's mark (one line) and the definition of a type; the mark if that has none."""
    if not type.schema_data or len(type.schema_data) > LONGEST_DEFINITION:
        return mark
    return b"\n".join((mark, type.schema_encoding.encode(), type.schema_data))


def defined_by(attachment: bytes, type: PayloadType) -> PayloadType | None:
    """The type with the definition in an attachment; None if there is none."""
    _, _, text = attachment.partition(b"\n")
    encoding, _, definition = text.partition(b"\n")
    schema_encoding = encoding[:16].decode(errors="replace")
    if not type.schema_name or not 0 < len(definition) <= LONGEST_DEFINITION:
        return None
    if schema_encoding not in _SCHEMA_ENCODINGS:
        return None
    return PayloadType(type.encoding, type.schema_name, schema_encoding, definition)


class SentDefinitions:
    """When the definition of a topic's type was sent last: it goes with the first message, and then now and again."""

    def __init__(self) -> None:
        self._sent: dict[str, float] = {}

    def attachment(self, mark: bytes, key: str, type: PayloadType, now: float) -> bytes:
        """The attachment of a message on a key, at `now` (seconds on a monotonic clock): with the definition or not."""
        if now - self._sent.get(key, -REPEAT_SECONDS) < REPEAT_SECONDS:
            return mark
        if len(self._sent) >= REMEMBERED_TOPICS:
            self._sent.clear()
        self._sent[key] = now
        return with_definition(mark, type)
