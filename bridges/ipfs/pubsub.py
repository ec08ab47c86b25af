"""The PubSub RPC of IPFS daemons: its two dialects, which one a daemon speaks, and lines of a subscription. Pure.

Since go-ipfs 0.11 and ipfs-core 0.13 (both December 2021) topics and data are multibase texts, and published data is a
multipart file, because the older dialect broke topics and data that contain a line feed. Sources: the changelogs of
go-ipfs 0.11.0 and ipfs-core 0.13.0, and `core/commands/pubsub.go` of go-ipfs 0.4.18.
"""

from __future__ import annotations

import binascii
import re
from base64 import b64decode, urlsafe_b64encode
from typing import TYPE_CHECKING, Final, NamedTuple, Protocol

import msgspec

if TYPE_CHECKING:
    from collections.abc import AsyncIterable, AsyncIterator

_NUMBERS: Final = re.compile(r"(\d+)\.(\d+)")
_MULTIBASE_SINCE_GO: Final = (0, 11)
_MULTIBASE_SINCE_JS: Final = (0, 13)
_KUBO_SINCE: Final = (0, 14)
"""The first go-ipfs version that is called Kubo."""
_UNKNOWN_VERSION: Final = (9999, 0)
"""An unreadable version counts as a recent one."""


class DaemonVersion(msgspec.Struct, frozen=True):
    """A daemon's answer to `/api/v0/version`."""

    version: str = msgspec.field(default="", name="Version")
    golang: str = msgspec.field(default="", name="Golang")
    js_core: str = msgspec.field(default="", name="ipfs-core")
    js_interface: str = msgspec.field(default="", name="interface-ipfs-core")

    @property
    def is_js(self) -> bool:
        """Whether it is js-ipfs; all others are go-ipfs or Kubo."""
        return bool(self.js_core or self.js_interface)

    def __str__(self) -> str:
        if self.is_js:
            return f"js-ipfs {self.version or 'unknown'}"
        return f"{'go-ipfs' if _numbers(self.version) < _KUBO_SINCE else 'kubo'} {self.version or 'unknown'}"


class PubsubMessage(NamedTuple):
    """A message received on a topic: its publisher, as the daemon writes it, and the data."""

    sender: str
    data: bytes


class _SubscriptionLine(msgspec.Struct):
    """A line of a subscription. The first line of js-ipfs is `{}`."""

    sender: str = msgspec.field(default="", name="from")
    data: str | None = None


_DECODER: Final = msgspec.json.Decoder(_SubscriptionLine)


class PubsubDialect(Protocol):
    """How a daemon encodes topics and data. `subscription` are a subscription's arguments besides the topic."""

    @property
    def name(self) -> str: ...

    @property
    def subscription(self) -> tuple[tuple[str, str], ...]: ...

    def topic(self, topic: str) -> str:
        """The topic as a call's argument."""

    def publication(self, data: bytes) -> tuple[list[tuple[str, str]], bytes | None]:
        """How to publish data: further arguments of the call, and the content of its file, if it has one."""

    def message(self, line: bytes) -> PubsubMessage | None:
        """The message in a line of a subscription; None for a line without one. Raises `ValueError`."""


class MultibaseDialect:
    """The current dialect: topics and data are base64url without padding, prefixed with `u`."""

    name = "multibase"
    subscription: tuple[tuple[str, str], ...] = ()

    def topic(self, topic: str) -> str:
        """See `PubsubDialect`."""
        return "u" + urlsafe_b64encode(topic.encode()).rstrip(b"=").decode()

    def publication(self, data: bytes) -> tuple[list[tuple[str, str]], bytes | None]:
        """See `PubsubDialect`."""
        return [], data

    def message(self, line: bytes) -> PubsubMessage | None:
        """See `PubsubDialect`."""
        decoded = _decode(line)
        if decoded.data is None:
            return None
        if not decoded.data.startswith("u"):
            raise ValueError(f"the data is in multibase {decoded.data[:1]!r}, not in base64url")
        digits = decoded.data[1:]
        try:
            data = b64decode(digits + "=" * (-len(digits) % 4), altchars=b"-_", validate=True)
        except binascii.Error as error:
            raise ValueError(f"the data is not base64url: {error}") from None
        return PubsubMessage(decoded.sender, data)


class PlainDialect:
    """The dialect of daemons before December 2021: plain topics and published data; received data is base64."""

    name = "plain"
    subscription: tuple[tuple[str, str], ...] = (("discover", "true"),)

    def topic(self, topic: str) -> str:
        """See `PubsubDialect`."""
        return topic

    def publication(self, data: bytes) -> tuple[list[tuple[str, str]], bytes | None]:
        """See `PubsubDialect`. Raises `UnicodeDecodeError` (a `ValueError`), since an argument is text."""
        return [("arg", data.decode())], None

    def message(self, line: bytes) -> PubsubMessage | None:
        """See `PubsubDialect`."""
        decoded = _decode(line)
        if decoded.data is None:
            return None
        try:
            return PubsubMessage(decoded.sender, b64decode(decoded.data, validate=True))
        except binascii.Error as error:
            raise ValueError(f"the data is not base64: {error}") from None


def dialect_of(version: DaemonVersion) -> PubsubDialect:
    """The dialect of a daemon of that version; the current one if the version is unreadable."""
    if version.js_core:
        return PlainDialect() if _numbers(version.js_core) < _MULTIBASE_SINCE_JS else MultibaseDialect()
    if version.js_interface:  # js-ipfs did not report its core before 2020
        return PlainDialect()
    return PlainDialect() if _numbers(version.version) < _MULTIBASE_SINCE_GO else MultibaseDialect()


async def lines_of(chunks: AsyncIterable[bytes], *, limit: int) -> AsyncIterator[bytes]:
    """Yield each line without its line feed as soon as it is complete; an empty one for more than `limit` bytes.

    Data after the last line feed is dropped: the stream broke off inside a line.
    """
    kept, too_long = bytearray(), False
    async for chunk in chunks:
        *ends, rest = chunk.split(b"\n")
        for end in ends:
            too_long = too_long or len(kept) + len(end) > limit
            yield b"" if too_long else bytes(kept) + end
            kept.clear()
            too_long = False
        too_long = too_long or len(kept) + len(rest) > limit
        if too_long:
            kept.clear()
        else:
            kept += rest


def _numbers(text: str) -> tuple[int, int]:
    found = _NUMBERS.search(text)
    return (int(found[1]), int(found[2])) if found else _UNKNOWN_VERSION


def _decode(line: bytes) -> _SubscriptionLine:
    try:
        return _DECODER.decode(line)
    except (msgspec.DecodeError, UnicodeDecodeError) as error:
        raise ValueError(f"not a line of a subscription: {error}") from None
