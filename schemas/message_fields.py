"""Fields of messages: the checks, and the canonical form that each is brought to."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from msgspec.structs import force_setattr

from schemas.address import parse_address_or_name
from schemas.errors import InvalidMessage

if TYPE_CHECKING:
    from msgspec import Struct

MAX_UINT256: Final = 2**256 - 1

SIGNATURE_SIZE: Final = 65


def set_address(message: Struct, field: str, text: str) -> None:
    # The cached text replaces the equal one, so that an address in a million open orders is in memory once.
    canonical = parse_address_or_name(text)
    if canonical is not text:
        force_setattr(message, field, canonical)


def check_uint256(field: str, value: int) -> None:
    if type(value) is not int:
        raise InvalidMessage("field", f"{field}: expected an integer")
    if not 0 <= value <= MAX_UINT256:
        raise InvalidMessage("range", f"{field}: expected an integer from 0 to 2^256-1")


def are_uint256(first: int, second: int, third: int) -> bool:
    """Whether `check_uint256` accepts three values: one check for all is the fastest."""
    return type(first) is type(second) is type(third) is int and not (first | second | third) >> 256


def set_signature(message: Struct, text: str) -> None:
    if not text:
        return
    digits = hex_digits(text, SIGNATURE_SIZE)
    if digits is None:
        raise InvalidMessage("signature", "a signature is 130 hexadecimal digits, r, s and v")
    if digits != text:
        force_setattr(message, "signature", digits)


def set_hash(message: Struct, field: str, text: str) -> None:
    digits = hex_digits(text, 32)
    if digits is None:
        raise InvalidMessage("hash", f"{field}: expected 64 hexadecimal digits")
    if digits != text:
        force_setattr(message, field, digits)


def are_canonical(*digits: str) -> bool:
    """Whether texts are hexadecimal digits as `hex_digits` returns them: one check for all is the fastest."""
    joined = "".join(digits)
    try:
        return bytes.fromhex(joined).hex() == joined
    except ValueError:
        return False


def hex_digits(text: str, size: int) -> str | None:
    """The canonical hexadecimal digits of `size` bytes, or None if `text` is something else."""
    if text[:2] == "0x":
        text = text[2:]
    if len(text) != 2 * size:
        return None
    try:
        raw = bytes.fromhex(text)
    except ValueError:
        return None
    # bytes.fromhex() skips blanks, so a text with blanks among its characters is too short here.
    return raw.hex() if len(raw) == size else None
