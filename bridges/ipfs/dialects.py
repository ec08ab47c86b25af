"""How daemons of different ages write topics and data in their PubSub RPC. Pure.

Since go-ipfs 0.11 and ipfs-core 0.13 (both of December 2021) topics and data are multibase texts, and what is
published is a multipart file: the older way broke topics and data that hold a line end. Sources: the changelogs of
go-ipfs 0.11.0 and ipfs-core 0.13.0, and `core/commands/pubsub.go` of go-ipfs 0.4.18.
"""

from __future__ import annotations

import binascii
import re
from base64 import b64decode, urlsafe_b64encode
from typing import Final, NamedTuple, Protocol

import msgspec

_NUMBERS: Final = re.compile(r"(\d+)\.(\d+)")
_MULTIBASE_SINCE_GO: Final = (0, 11)
_MULTIBASE_SINCE_JS: Final = (0, 13)
_KUBO_SINCE: Final = (0, 14)
"""The first go-ipfs that is called Kubo."""
_NOT_TOLD: Final = (9999, 0)
"""A version that can't be read is taken for a new one."""


class Version(msgspec.Struct, frozen=True):
    """What a daemon says of itself (`/api/v0/version`)."""

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


class Event(NamedTuple):
    """A message that the daemon heard: who published it (as the daemon writes it), and the bytes."""

    sender: str
    data: bytes


class _Line(msgspec.Struct):
    """A line of a subscription. The first one of js-ipfs is `{}`."""

    sender: str = msgspec.field(default="", name="from")
    data: str | None = None


_LINES: Final = msgspec.json.Decoder(_Line)


class Dialect(Protocol):
    """One way of writing. `subscription` are the arguments of a subscription besides the topic."""

    @property
    def name(self) -> str: ...

    @property
    def subscription(self) -> tuple[tuple[str, str], ...]: ...

    def topic(self, topic: str) -> str:
        """The topic as the argument of a call."""

    def publication(self, data: bytes) -> tuple[list[tuple[str, str]], bytes | None]:
        """Data to publish: further arguments of the call, and the content of its file, if it has one."""

    def event(self, line: bytes) -> Event | None:
        """What a line of a subscription says; None for a line without a message.

        Raises `ValueError` for a line that can't be read.
        """


class Multibase:
    """Today's: everything base64url without padding behind a `u`."""

    name = "multibase"
    subscription: tuple[tuple[str, str], ...] = ()

    def topic(self, topic: str) -> str:
        """See `Dialect`."""
        return "u" + urlsafe_b64encode(topic.encode()).rstrip(b"=").decode()

    def publication(self, data: bytes) -> tuple[list[tuple[str, str]], bytes | None]:
        """See `Dialect`."""
        return [], data

    def event(self, line: bytes) -> Event | None:
        """See `Dialect`."""
        read = _read(line)
        if read.data is None:
            return None
        if not read.data.startswith("u"):
            raise ValueError(f"the data is in multibase {read.data[:1]!r}, not in base64url")
        digits = read.data[1:]
        try:
            data = b64decode(digits + "=" * (-len(digits) % 4), altchars=b"-_", validate=True)
        except binascii.Error as error:
            raise ValueError(f"the data is not base64url: {error}") from None
        return Event(read.sender, data)


class Plain:
    """That of daemons before: topics and published data as they are, data that is heard in base64."""

    name = "plain"
    subscription: tuple[tuple[str, str], ...] = (("discover", "true"),)

    def topic(self, topic: str) -> str:
        """See `Dialect`."""
        return topic

    def publication(self, data: bytes) -> tuple[list[tuple[str, str]], bytes | None]:
        """See `Dialect`. Raises `UnicodeDecodeError` (a `ValueError`): an argument is text."""
        return [("arg", data.decode())], None

    def event(self, line: bytes) -> Event | None:
        """See `Dialect`."""
        read = _read(line)
        if read.data is None:
            return None
        try:
            return Event(read.sender, b64decode(read.data, validate=True))
        except binascii.Error as error:
            raise ValueError(f"the data is not base64: {error}") from None


def dialect_of(version: Version) -> Dialect:
    """What a daemon of that version speaks. One that can't be told is taken for a new one."""
    if version.js_core:
        return Plain() if _numbers(version.js_core) < _MULTIBASE_SINCE_JS else Multibase()
    if version.js_interface:  # js-ipfs did not name its core before 2020
        return Plain()
    return Plain() if _numbers(version.version) < _MULTIBASE_SINCE_GO else Multibase()


def _numbers(text: str) -> tuple[int, int]:
    found = _NUMBERS.search(text)
    return (int(found[1]), int(found[2])) if found else _NOT_TOLD


def _read(line: bytes) -> _Line:
    try:
        return _LINES.decode(line)
    except (msgspec.DecodeError, UnicodeDecodeError) as error:
        raise ValueError(f"not a line of a subscription: {error}") from None
