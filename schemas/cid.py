"""CIDv0, the name of a file by its content: base58 of `0x12 0x20` and the sha2-256 digest of the root block.

Only this form is accepted, 46 characters for exactly 34 bytes: the hash of a message packs the raw bytes of two CIDs
without their lengths, so CIDs of other lengths would let a byte move from one to the other. A CIDv0 has no checksum: a
mistyped one is usually valid, but names nothing.
"""

from __future__ import annotations

from contextvars import ContextVar
from functools import lru_cache
from struct import Struct
from typing import TYPE_CHECKING, Final

from schemas.errors import InvalidCid

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping

CID_LENGTH: Final = 46
MULTIHASH_PREFIX: Final = b"\x12\x20"
CACHED: Final = 8192
"""The most texts of a kind that are remembered as checked: CIDs, addresses, keys."""

_MULTIHASH_SIZE: Final = 34
_ALPHABET: Final = "123456789ABCDEFGHJKLMNPQRSTUVWXYZabcdefghijkmnopqrstuvwxyz"
_NO_DIGIT: Final = 0xFF
_DIGIT: Final = bytes(_ALPHABET.find(chr(code)) & 0xFF for code in range(256))

# Decoding processes 48 digits at a time (a CIDv0 has 46), a byte for each in one integer, and adds up neighbours in all
# lanes at once: first pairs of digits, then pairs of pairs, then fours; six words of eight digits remain. A pair's high
# digit counts 256 times as a byte and should count 58 times, so 198 times that digit is subtracted; and so on. Every
# message with a new objective has a CID that is not in the cache, and this halves the time for it. Many blocks in one
# integer take half of that again.
_BLOCK: Final = 48
_SIX_WORDS: Final = Struct(">6Q")
_FILL: Final = "1" * (_BLOCK - CID_LENGTH)
"""Zeros before a CID's digits, which make it a block."""

_ahead: Final[ContextVar[Mapping[str, bytes]]] = ContextVar("CIDs that were parsed ahead", default={})  # noqa: B039
"""What `parse_ahead` parsed last: a few hundred, which stay in the CPU's caches."""


def parse_cid(text: str) -> bytes:
    """The 34-byte sha2-256 multihash that a CIDv0 names. Raises `InvalidCid`."""
    return _ahead.get().get(text) or _parse(text)


@lru_cache(maxsize=CACHED)
def _parse(text: str) -> bytes:
    if len(text) != CID_LENGTH:
        raise InvalidCid(text, f"it has {CID_LENGTH} characters, this text {len(text)}")
    digits = _digits(_FILL + text)
    if _NO_DIGIT in digits:
        raise InvalidCid(text, "a character is not in the base58 alphabet")
    # 46 digits are never more than 34 bytes; with fewer the check of the first two bytes fails.
    multihash = next(_blocks(digits)).to_bytes(_MULTIHASH_SIZE, "big")
    if multihash[:2] != MULTIHASH_PREFIX:
        raise InvalidCid(text, "it is not a sha2-256 multihash")
    return multihash


def parse_ahead(texts: Iterable[str]) -> None:
    """Parse new CIDs together; `parse_cid` looks them up until the next call in this thread or task.

    Wrong ones are left to it. They stay out of its cache, which is for CIDs that come again.
    """
    texts = [text for text in texts if len(text) == CID_LENGTH]
    digits = _digits("".join([_FILL + text for text in texts]))
    if _NO_DIGIT in digits:
        texts = [text for text in texts if _NO_DIGIT not in _digits(text)]
        digits = _digits("".join([_FILL + text for text in texts]))
    multihashes = [number.to_bytes(_MULTIHASH_SIZE, "big") for number in _blocks(digits)]
    pairs = zip(texts, multihashes, strict=True)
    _ahead.set({text: multihash for text, multihash in pairs if multihash.startswith(MULTIHASH_PREFIX)})


def is_cid(text: str) -> bool:
    try:
        parse_cid(text)
    except InvalidCid:
        return False
    return True


def format_cid(multihash: bytes) -> str:
    """The CIDv0 of a 34-byte sha2-256 multihash. Raises `InvalidCid` for any other multihash."""
    if multihash[:2] != MULTIHASH_PREFIX or len(multihash) != _MULTIHASH_SIZE:
        raise InvalidCid(multihash.hex(), "its multihash is not 0x12 0x20 and 32 bytes")
    return encode_base58(multihash)


def cid_of_digest(digest: bytes) -> str:
    """The CIDv0 of a block with this 32-byte sha2-256 digest. Raises `InvalidCid` for another length."""
    return format_cid(MULTIHASH_PREFIX + digest)


def encode_base58(data: bytes) -> str:
    """The base58 text of `data`; every leading zero byte becomes a leading `1`."""
    number = int.from_bytes(data, "big")
    digits = []
    while number:
        number, digit = divmod(number, 58)
        digits.append(_ALPHABET[digit])
    zeros = len(data) - len(data.lstrip(b"\0"))
    return "1" * zeros + "".join(reversed(digits))


def _digits(text: str) -> bytes:
    """The value of each base58 digit; `_NO_DIGIT` for any other character."""
    return text.encode("ascii", "replace").translate(_DIGIT)


def _blocks(digits: bytes) -> Iterator[int]:
    """The values of blocks of 48 base58 digits."""
    count = len(digits) // _BLOCK
    pairs, fours, eights = _masks(count)
    lanes = int.from_bytes(digits, "big")
    lanes -= (2**8 - 58) * (lanes >> 8 & pairs)
    lanes -= (2**16 - 58**2) * (lanes >> 16 & fours)
    lanes -= (2**32 - 58**4) * (lanes >> 32 & eights)
    for a, b, c, d, e, f in _SIX_WORDS.iter_unpack(lanes.to_bytes(len(digits), "big")):
        yield ((((a * 58**8 + b) * 58**8 + c) * 58**8 + d) * 58**8 + e) * 58**8 + f


@lru_cache(maxsize=16)
def _masks(count: int) -> tuple[int, ...]:
    """For that many blocks: what chooses the low digit of each pair, the low pair of each four, and so on."""
    size = _BLOCK * count
    return tuple(int.from_bytes((bytes(half) + b"\xff" * half) * (size // (2 * half)), "big") for half in (1, 2, 4))
