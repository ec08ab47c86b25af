"""What a client may send: the request that opens a WebSocket, and its frames. Pure."""

from __future__ import annotations

import hmac
from typing import Final, NamedTuple
from urllib.parse import parse_qs, urlsplit

from bridges.foxglove.errors import ClientRefused
from bridges.foxglove.options import APPS, FoxgloveOptions

LONGEST_FRAME: Final = 1 << 18
"""Bytes of one message of a client: it subscribes to topics, and controls the playback."""
_CARRIED: Final = ("upgrade", "connection", "sec-websocket-key", "sec-websocket-version", "sec-websocket-protocol")
"""The headers that the SDK's server gets to see: no extensions, so nothing is compressed."""


class Upgrade(NamedTuple):
    """A request for a WebSocket."""

    target: str
    headers: dict[str, str]

    @classmethod
    def parse(cls, head: bytes) -> Upgrade:
        """The request in the bytes up to the first empty line. Raises `ClientRefused`."""
        try:
            first, *lines = head.decode("latin-1").rstrip("\r\n").split("\r\n")
            method, target, version = first.split(" ")
            pairs = [(name.lower(), value.strip()) for name, _, value in (line.partition(":") for line in lines)]
        except ValueError:
            raise ClientRefused("400 Bad Request", "this is no HTTP request") from None
        headers = dict(pairs)
        if method != "GET" or version != "HTTP/1.1" or len(headers) != len(pairs):
            raise ClientRefused("400 Bad Request", "a WebSocket is opened by one plain GET request")
        if headers.get("upgrade", "").lower() != "websocket":
            raise ClientRefused(
                "426 Upgrade Required", "this is a server for Foxglove: open a connection there, to ws://…"
            )
        return cls(target, headers)

    def check(self, options: FoxgloveOptions) -> None:
        """Raise `ClientRefused` for a page of another site, and for a client without the token."""
        origin = self.headers.get("origin")
        if origin is not None and origin not in (*APPS, *options.origins):
            raise ClientRefused("403 Forbidden", "pages of this site may not connect; name it with --origin")
        if options.token:
            given = parse_qs(urlsplit(self.target).query).get("token", [""])[0]
            bearer = self.headers.get("authorization", "").removeprefix("Bearer ")
            if not hmac.compare_digest((given or bearer).encode(), options.token.encode()):
                raise ClientRefused("401 Unauthorized", "add the token to the address: ?token=…")

    def carried(self, host: str) -> bytes:
        """The request as the SDK's server gets it."""
        lines = [f"{name}: {self.headers[name]}" for name in _CARRIED if name in self.headers]
        return "\r\n".join(["GET / HTTP/1.1", f"host: {host}", *lines, "", ""]).encode("latin-1")


class FrameGuard:
    """Watches the bytes that a client sends. Raises `ClientRefused` for a message that is too long, or in parts."""

    def __init__(self) -> None:
        self._head = b""
        self._left = 0

    def feed(self, data: bytes) -> None:
        """Look at the next bytes."""
        at = 0
        while at < len(data):
            if self._left:
                taken = min(self._left, len(data) - at)
                self._left -= taken
                at += taken
                continue
            self._head += data[at : at + 1]
            at += 1
            if (size := _size(self._head)) is not None:
                if size > LONGEST_FRAME or not self._head[0] & 0x80:
                    raise ClientRefused("1009", "a message is too long")
                self._left, self._head = size, b""


def _size(head: bytes) -> int | None:
    """How many bytes follow the header of a frame, if it is whole: the mask, and the payload."""
    if len(head) < 2:
        return None
    length, masked = head[1] & 0x7F, 4 * (head[1] >> 7)
    extra = {126: 2, 127: 8}.get(length, 0)
    if len(head) < 2 + extra:
        return None
    return masked + (int.from_bytes(head[2:], "big") if extra else length)
