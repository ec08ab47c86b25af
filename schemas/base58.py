"""Base58 with Bitcoin's alphabet, without a checksum: how a CIDv0 is written."""

from __future__ import annotations

from struct import Struct
from typing import Final

from schemas.errors import InputError

_ALPHABET: Final = "123456789ABCDEFGHJKLMNPQRSTUVWXYZabcdefghijkmnopqrstuvwxyz"
_NO_DIGIT: Final = 0xFF
_DIGIT: Final = bytes(_ALPHABET.find(chr(code)) & 0xFF for code in range(256))

# Decoding takes 48 digits at a time (a CIDv0 has 46), a byte each in one integer, and adds up neighbours in all of its
# lanes at once: first pairs of digits, then pairs of pairs, then of those; six words of eight digits are left. A CID
# that nobody has seen yet is decoded for every message with a new objective, and this halves its time.
_BLOCK: Final = 48
_PAIRS: Final = int.from_bytes(b"\x00\xff" * 24, "big")
_FOURS: Final = int.from_bytes(b"\x00\x00\xff\xff" * 12, "big")
_EIGHTS: Final = int.from_bytes(b"\x00\x00\x00\x00\xff\xff\xff\xff" * 6, "big")
_SIX_WORDS: Final = Struct(">6Q")


def encode(data: bytes) -> str:
    """The base58 text of `data`; every leading zero byte becomes a leading `1`."""
    number = int.from_bytes(data, "big")
    digits = []
    while number:
        number, digit = divmod(number, 58)
        digits.append(_ALPHABET[digit])
    zeros = len(data) - len(data.lstrip(b"\0"))
    return "1" * zeros + "".join(reversed(digits))


def decode(text: str) -> bytes:
    """The bytes behind a base58 text. Raises `InputError` if a character is not in the alphabet."""
    number = decode_number(text)
    zeros = len(text) - len(text.lstrip("1"))
    return bytes(zeros) + number.to_bytes((number.bit_length() + 7) // 8, "big")


def decode_number(text: str) -> int:
    """The number whose base58 digits are `text`. Raises `InputError` if a character is not in the alphabet."""
    try:
        digits = text.encode("ascii").translate(_DIGIT)
    except UnicodeEncodeError:
        digits = b"\xff"
    if _NO_DIGIT in digits:
        raise InputError(f"{text[:80]!r} is not base58")
    head = len(digits) % _BLOCK
    number = _block(digits[:head])
    for start in range(head, len(digits), _BLOCK):
        number = number * 58**_BLOCK + _block(digits[start : start + _BLOCK])
    return number


def _block(digits: bytes) -> int:
    """The value of up to 48 base58 digits."""
    lanes = int.from_bytes(digits, "big")
    lanes = (lanes & _PAIRS) + 58 * (lanes >> 8 & _PAIRS)
    lanes = (lanes & _FOURS) + 58**2 * (lanes >> 16 & _FOURS)
    lanes = (lanes & _EIGHTS) + 58**4 * (lanes >> 32 & _EIGHTS)
    value = 0
    for word in _SIX_WORDS.unpack(lanes.to_bytes(_BLOCK, "big")):
        value = value * 58**8 + word
    return value
