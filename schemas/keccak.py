"""Keccak-256 as Ethereum uses it (the original padding, not that of SHA3-256)."""

from __future__ import annotations

from sha3 import keccak_256  # type: ignore[import-untyped]


def keccak256(data: bytes) -> bytes:
    """The 32-byte Keccak-256 digest of `data`."""
    digest: bytes = keccak_256(data).digest()
    return digest
