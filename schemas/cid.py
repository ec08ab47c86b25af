"""CIDv0: the name of a content, base58 of `0x12 0x20` and the sha2-256 digest of the root block.

Only this one form is taken, 46 characters for exactly 34 bytes: the hash of a message packs the raw bytes of two
names without their lengths, so names of other lengths would let a byte move from one to the other. A CIDv0 has no
checksum: a typing error is most often a valid name that nobody has.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Final

from schemas import base58
from schemas.errors import InputError, InvalidCid

CID_LENGTH: Final = 46
MULTIHASH_PREFIX: Final = b"\x12\x20"

_MULTIHASH_SIZE: Final = 34
_CACHED: Final = 8192


@lru_cache(maxsize=_CACHED)
def parse_cid(text: str) -> bytes:
    """The 34-byte sha2-256 multihash that a CIDv0 names. Raises `InvalidCid`."""
    if len(text) != CID_LENGTH:
        raise InvalidCid(text, f"it has {CID_LENGTH} characters, this text {len(text)}")
    try:
        # 46 digits are never more than 34 bytes, and what has fewer fails by its first two.
        multihash = base58.decode_number(text).to_bytes(_MULTIHASH_SIZE, "big")
    except InputError:
        raise InvalidCid(text, "a character is not in the base58 alphabet") from None
    if multihash[:2] != MULTIHASH_PREFIX:
        raise InvalidCid(text, "it is not a sha2-256 multihash")
    return multihash


def format_cid(multihash: bytes) -> str:
    """The CIDv0 of a 34-byte sha2-256 multihash. Raises `InvalidCid` for any other multihash."""
    if multihash[:2] != MULTIHASH_PREFIX or len(multihash) != _MULTIHASH_SIZE:
        raise InvalidCid(multihash.hex(), "its multihash is not 0x12 0x20 and 32 bytes")
    return base58.encode(multihash)


def cid_of_digest(digest: bytes) -> str:
    """The CIDv0 of a block with this 32-byte sha2-256 digest. Raises `InvalidCid` for another length."""
    return format_cid(MULTIHASH_PREFIX + digest)
