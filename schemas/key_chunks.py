"""Chunks of keys: what each may contain, and its canonical text.

Every function returns the canonical form of a text, or raises `InvalidKey`. Accepted texts contain no wildcards,
blanks, control characters or empty chunks, and do not begin with `@`.
"""

from __future__ import annotations

import re
from functools import lru_cache
from typing import TYPE_CHECKING, Final

from schemas.address import parse_address, parse_address_or_name
from schemas.cid import parse_cid
from schemas.errors import InvalidAddress, InvalidCid, InvalidKey

if TYPE_CHECKING:
    from collections.abc import Callable

MAX_PATH_LENGTH: Final = 256

_CACHED: Final = 8192
_CHUNK: Final = r"[A-Za-z0-9_~-][A-Za-z0-9_.~-]*"
_ONE_CHUNK: Final = re.compile(_CHUNK)
_CHUNKS: Final = re.compile(rf"{_CHUNK}(?:/{_CHUNK})*")


@lru_cache(maxsize=_CACHED)
def lighthouse_chunk(text: str) -> str:
    """A lighthouse: its ENS name, or its address if it has none; in lower case."""
    try:
        return parse_address_or_name(text).lower()
    except InvalidAddress:
        raise InvalidKey(text, "a lighthouse is named by an ENS name or an address") from None


@lru_cache(maxsize=_CACHED)
def address_chunk(text: str) -> str:
    """An address, in lower case."""
    try:
        return parse_address(text).lower()
    except InvalidAddress as error:
        raise InvalidKey(text, str(error)) from None


def cid_chunk(text: str) -> str:
    """A CIDv0."""
    try:
        parse_cid(text)
    except InvalidCid as error:
        raise InvalidKey(text, str(error)) from None
    return text


def hash_chunk(text: str) -> str:
    """A 32-byte hash: 64 hexadecimal digits in lower case, without `0x`."""
    try:
        # This also rejects upper case and the blanks that bytes.fromhex() skips.
        if len(text) == 64 and bytes.fromhex(text).hex() == text:
            return text
    except ValueError:
        pass
    raise InvalidKey(text, "a hash is 64 hexadecimal digits in lower case, without 0x")


def name_chunk(text: str) -> str:
    """A freely chosen name: a role, a device."""
    if len(text) > MAX_PATH_LENGTH or not _ONE_CHUNK.fullmatch(text):
        raise InvalidKey(text, "a name consists of letters, digits, - _ ~ and, after the first character, dots")
    return text


def check_event(text: str, *known: str) -> None:
    """Raise `InvalidKey` for an event that is not one of `known`."""
    if text not in known:
        raise InvalidKey(text, f"it is not one of the events {', '.join(known)}")


def path_chunks(text: str) -> str:
    """Several names separated by `/`: a service."""
    if len(text) > MAX_PATH_LENGTH or not _CHUNKS.fullmatch(text):
        raise InvalidKey(text, f"a path is names separated by /, at most {MAX_PATH_LENGTH} characters long")
    return text


def topic_chunks(text: str) -> str:
    """A topic as in ROS: `/`, and names separated by `/`."""
    if not text.startswith("/"):
        raise InvalidKey(text, "a topic begins with /")
    path_chunks(text[1:])
    return text


CANONICAL: Final[dict[str, Callable[[str], str]]] = {
    "lighthouse": lighthouse_chunk,
    "agent": address_chunk,
    "liability": address_chunk,
    "provider": address_chunk,
    "model": cid_chunk,
    "cid": cid_chunk,
    "hash": hash_chunk,
    "order": hash_chunk,
    "tx": hash_chunk,
    "role": name_chunk,
    "device": name_chunk,
    "event": name_chunk,
    "service": path_chunks,
    "topic": topic_chunks,
}
"""The check of each field of a key, by the field's name."""
