"""The 33 bytes that rmw_zenoh attaches to each message, request and reply.

A process of ROS 2 aborts when they are malformed, so they are made here only.
"""

from __future__ import annotations

from struct import Struct
from typing import Final, NamedTuple

_LAYOUT: Final = Struct("<qqB16s")
GID_SIZE: Final = 16
ATTACHMENT_SIZE: Final = _LAYOUT.size
LARGEST: Final = (1 << 63) - 1


class RosAttachment(NamedTuple):
    """Who sent a message, when, and as which one."""

    sequence: int
    """Counted by the sender: of its messages, or of its requests; a reply has that of its request."""
    time_ns: int
    """When it was sent, in nanoseconds since 1970."""
    gid: bytes
    """The sender: 16 bytes. A reply has that of its request."""

    def encode(self) -> bytes:
        """The bytes. Raises `ValueError` for what has no form in them."""
        if len(self.gid) != GID_SIZE or not (0 <= self.sequence <= LARGEST and 0 <= self.time_ns <= LARGEST):
            raise ValueError(f"{self} can't be attached to a message of ROS 2")
        return _LAYOUT.pack(self.sequence, self.time_ns, GID_SIZE, self.gid)


def parse_attachment(data: bytes) -> RosAttachment | None:
    """What the bytes say; None if they are malformed."""
    if len(data) != ATTACHMENT_SIZE:
        return None
    sequence, time_ns, size, gid = _LAYOUT.unpack(data)
    return RosAttachment(sequence, time_ns, gid) if size == GID_SIZE and sequence >= 0 else None
