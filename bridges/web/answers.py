"""Reading requests and writing answers of the page's interface."""

from __future__ import annotations

from typing import Any, Final, TypeVar

import msgspec
from aiohttp import web

from bridges.web.errors import InvalidRequest
from schemas import parse_address, parse_cid

T = TypeVar("T")

SANDBOX: Final = {"Content-Security-Policy": "default-src 'none'; sandbox"}
"""What strangers made is shown by nothing but our own page."""
FOREVER: Final = {"Cache-Control": "private, max-age=31536000, immutable"}
"""What a CID names never changes."""


def answer(content: Any, *, status: int = 200) -> web.Response:
    """A JSON response."""
    return web.Response(body=msgspec.json.encode(content), status=status, content_type="application/json")


async def body_of(request: web.Request, kind: type[T]) -> T:
    """The JSON body. Raises `InvalidRequest`."""
    try:
        return msgspec.json.decode(await request.read(), type=kind)
    except (msgspec.DecodeError, UnicodeDecodeError) as error:
        raise InvalidRequest(f"the body: {error}"[:200]) from None


def address_in(request: web.Request) -> str:
    """The address in the path. Raises `InvalidAddress`."""
    return parse_address(request.match_info["address"])


def cid_in(request: web.Request) -> str:
    """The CID in the path. Raises `InvalidCid`."""
    return parse_text_cid(request.match_info["cid"])


def parse_text_cid(text: str) -> str:
    """The text, if it is a CID. Raises `InvalidCid`."""
    parse_cid(text)
    return text


def amount(text: str) -> int:
    """An amount in the smallest unit. Raises `InvalidRequest`."""
    if not (text.isascii() and text.isdigit() and len(text) <= 78):
        raise InvalidRequest("an amount is a decimal number in the smallest unit")
    return int(text)


def number_in(request: web.Request, name: str, default: int, *, least: int = 0, most: int = 10**9) -> int:
    """A number in the query, at most `most`. Raises `InvalidRequest`."""
    text = request.query.get(name, "")
    if not text:
        return default
    try:
        number = int(text)
    except ValueError:
        raise InvalidRequest(f"{name} is a number") from None
    if number < least:
        raise InvalidRequest(f"{name} is at least {least}")
    return min(number, most)
