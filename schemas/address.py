"""Ethereum addresses, the ENS names that may replace them, and the hash that both rest on.

Inside the program an address is its EIP-55 text (`0x` and 40 digits in mixed case), so equal addresses are equal
strings. Parsing is cached, because the same few lighthouses, tokens and agents occur in every message.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Final

# `sha3` itself imports hashlib, and with it OpenSSL: 3.5 MB that an edge agent does not need.
from _pysha3 import keccak_256  # type: ignore[import-not-found]

from schemas.cid import CACHED
from schemas.errors import InvalidAddress

ZERO_ADDRESS: Final = "0x0000000000000000000000000000000000000000"

_LABEL: Final = frozenset("abcdefghijklmnopqrstuvwxyz0123456789-_")
_TOP_LEVEL: Final = (".eth", ".sid", ".test")
_LOW_BIT_OF_40: Final = int.from_bytes(b"\x01" * 40, "big")


def keccak256(data: bytes) -> bytes:
    """The 32-byte Keccak-256 digest of `data`, with Ethereum's padding (not that of SHA3-256)."""
    digest: bytes = keccak_256(data).digest()
    return digest


def checksum_address(raw: bytes) -> str:
    """The EIP-55 text of a 20-byte address.

    Raises `InvalidAddress` if `raw` is not 20 bytes long.
    """
    if len(raw) != 20:
        raise InvalidAddress(raw.hex(), f"an address has 20 bytes, not {len(raw)}")
    lower = raw.hex().encode()
    # EIP-55: a letter is upper case if the same digit of the text's hash is 8 or more. This computes all 40 characters
    # at once in one integer with a byte for each: among the hash's digits, 8 and 9 have bit 3 set and a-f bit 6; among
    # the address's digits, only letters have bit 6; clearing bit 5 of a letter makes it upper case.
    text = int.from_bytes(lower, "big")
    digest = int.from_bytes(keccak256(lower)[:20].hex().encode(), "big")
    capitals = (digest >> 3 | digest >> 6) & text >> 6 & _LOW_BIT_OF_40
    return "0x" + (text ^ capitals << 5).to_bytes(40, "big").decode()


@lru_cache(maxsize=CACHED)
def parse_address(text: str) -> str:
    """The EIP-55 form of an address text.

    Letters may be all lower or all upper case; a mixed-case text must pass EIP-55. Raises `InvalidAddress`.
    """
    if len(text) != 42 or text[:2] != "0x":
        raise InvalidAddress(text, "an address is 0x and 40 hexadecimal digits")
    digits = text[2:]
    try:
        raw = bytes.fromhex(digits)
    except ValueError:
        raw = b""
    if len(raw) != 20:  # bytes.fromhex() skips blanks
        raise InvalidAddress(text, "an address is 0x and 40 hexadecimal digits")
    checksum = checksum_address(raw)
    if text != checksum and digits != digits.lower() and digits != digits.upper():
        raise InvalidAddress(text, "its EIP-55 checksum does not hold; correct it, or write it in lower case")
    return checksum


def shortened(address: str) -> str:
    return f"{address[:6]}…{address[-4:]}"


@lru_cache(maxsize=CACHED)
def address_bytes(text: str) -> bytes:
    """The 20 bytes of an address text. Raises `InvalidAddress`, also for an ENS name."""
    return bytes.fromhex(parse_address(text)[2:])


def is_ens_name(text: str) -> bool:
    """Whether `text` is an ENS name that may replace an address: `*.eth`, `*.sid` or `*.test`.

    Labels are ASCII letters of either case, digits, `-` and `_`, so every name can be part of a key.
    """
    if len(text) > 255 or not text.isascii():
        return False
    name = text.lower()
    return name.endswith(_TOP_LEVEL) and all(label and _LABEL.issuperset(label) for label in name.split("."))


@lru_cache(maxsize=CACHED)
def parse_address_or_name(text: str) -> str:
    """The EIP-55 form of an address, or the lower-case form of an ENS name. Raises `InvalidAddress`."""
    return text.lower() if is_ens_name(text) else parse_address(text)
