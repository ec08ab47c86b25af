"""The messages of `messages-generation-3.json` and `messages-generation-5.json`."""

from __future__ import annotations

from pathlib import Path
from typing import Final

import msgspec


class Vector(msgspec.Struct, frozen=True):
    """One message of a legacy client, and what belongs to it; the binary fields are hexadecimal with `0x`."""

    kind: str
    private_key: str
    signer: str
    hash: str
    wire: str

    @property
    def payload(self) -> bytes:
        """The bytes on the channel."""
        return self.wire.encode()

    @property
    def key(self) -> bytes:
        """The private key."""
        return bytes.fromhex(self.private_key[2:])


def read_vectors(generation: int) -> list[Vector]:
    """The sixty messages of a generation."""
    path = Path(__file__).with_name(f"messages-generation-{generation}.json")
    return msgspec.json.decode(path.read_bytes(), type=list[Vector])


VECTORS: Final = {3: read_vectors(3), 5: read_vectors(5)}
ALL_VECTORS: Final = VECTORS[3] + VECTORS[5]
