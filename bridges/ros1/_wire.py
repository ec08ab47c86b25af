"""The protocols of ROS 1, without ports or clocks: TCPROS connections, and the XML-RPC calls of masters and nodes.

TCPROS: a connection begins with a header from each side: its length, then fields as in `topic=/chatter`, each with its
length. Messages follow, each with its length; a service's reply has a byte before it that says whether it succeeded.

A node listens for both protocols on one port: no XML-RPC request begins with the length of a header.
"""

from __future__ import annotations

import re
import struct
import xmlrpc.client
from typing import TYPE_CHECKING, Any, Final, NamedTuple
from urllib.parse import urlsplit

from mesh.errors import InputError, RemoteError

if TYPE_CHECKING:
    from collections.abc import Mapping


class Ros1WireLimits(NamedTuple):
    """What is read of a connection: in bytes, and of a name in characters."""

    header: int = 256 << 10
    """A connection's header; it holds the definition of the message."""
    message: int = 16 << 20
    """A message."""
    head: int = 16 << 10
    """The head of an HTTP request or reply."""
    call: int = 4 << 20
    """An XML-RPC request or reply; a master's state of a large graph has some hundred thousand."""
    name: int = 512
    """A name in the graph."""


WIRE_LIMITS: Final = Ros1WireLimits()

SUCCESS: Final = 1
FAILURE: Final = 0
ERROR: Final = -1
"""The codes of replies: done; failed; the caller's mistake."""

_LENGTH: Final = struct.Struct("<I")
_NAME: Final = re.compile(r"/?[A-Za-z][\w]*(/[A-Za-z][\w]*)*", re.ASCII)


class Ros1Error(RemoteError, code="ros1-error"):
    """Another program of the ROS system does not answer, or refuses what it is asked; the text says who and why."""


class WireError(Ros1Error, code="ros1-malformed"):
    """What arrived is not the protocol, or is larger than is accepted."""


class InvalidGraphName(InputError, code="invalid-ros1-name"):
    """A name that no node, topic, service or parameter of ROS 1 can have."""

    def __init__(self, name: str) -> None:
        super().__init__(
            f"{name!r} is no name in ROS 1",
            hint="a name is as in /liability/ready: letters, digits and underscores between slashes",
        )
        self.name = name


def resolve(name: str, node: str) -> str:
    """The absolute name that a name has for a node: `~x` is below it, others in its namespace."""
    if len(name) > WIRE_LIMITS.name or not _NAME.fullmatch(name.removeprefix("~").removeprefix("/")):
        raise InvalidGraphName(name)
    if name.startswith("~"):
        return f"{node}/{name[1:].lstrip('/')}"
    return name if name.startswith("/") else f"{node.rpartition('/')[0]}/{name}"


def encode_header(fields: Mapping[str, str]) -> bytes:
    """A connection's header with its length."""
    lines = [f"{name}={value}".encode() for name, value in fields.items()]
    body = b"".join(_LENGTH.pack(len(line)) + line for line in lines)
    return _LENGTH.pack(len(body)) + body


def decode_header(body: bytes) -> dict[str, str]:
    """The fields of a connection's header, without its length. Raises `WireError`."""
    fields, at = dict[str, str](), 0
    while at < len(body):
        if at + _LENGTH.size > len(body):
            raise WireError("a header ends within a length")
        (length,) = _LENGTH.unpack_from(body, at)
        at += _LENGTH.size
        line = body[at : at + length]
        name, separator, value = line.partition(b"=")
        if len(line) != length or not separator:
            raise WireError("a header has a field that is not as in name=value")
        fields[name.decode(errors="replace")] = value.decode(errors="replace")
        at += length
    return fields


def length_of(prefix: bytes | bytearray, limit: int) -> int:
    """The length that four bytes say. Raises `WireError` if it is over the limit."""
    (length,) = _LENGTH.unpack(prefix)
    if length > limit:
        raise WireError(f"a length of {length:,} bytes; the most are {limit:,}")
    return int(length)


def frame(payload: bytes) -> bytes:
    """A message with its length."""
    return _LENGTH.pack(len(payload)) + payload


class Frames:
    """The messages in a stream of bytes: `feed` what arrives."""

    def __init__(self) -> None:
        self._rest = bytearray()

    def feed(self, data: bytes) -> list[bytes]:
        """The messages that are complete now. Raises `WireError` for one that is too large."""
        self._rest += data
        found, at, rest = list[bytes](), 0, self._rest
        while len(rest) - at >= _LENGTH.size:
            end = at + _LENGTH.size + length_of(rest[at : at + _LENGTH.size], WIRE_LIMITS.message)
            if end > len(rest):
                break
            found.append(bytes(rest[at + _LENGTH.size : end]))
            at = end
        del rest[:at]
        return found


def http_length(head: bytes) -> int:
    """The length of the body that belongs to the head of an HTTP message. Raises `WireError`."""
    found = re.search(rb"^content-length:[ \t]*(\d{1,12})[ \t]*\r?$", head, re.IGNORECASE | re.MULTILINE)
    if found is None:
        raise WireError("an HTTP message says no length")
    if (length := int(found[1])) > WIRE_LIMITS.call:
        raise WireError(f"an XML-RPC call of {length:,} bytes; the most are {WIRE_LIMITS.call:,}")
    return length


def stays_open(head: bytes) -> bool:
    """Whether the sender of an HTTP request may send another one on its connection."""
    first, _, rest = head.partition(b"\n")
    return b"HTTP/1.1" in first and not re.search(rb"^connection:[ \t]*close", rest, re.IGNORECASE | re.MULTILINE)


def encode_call(uri: str, method: str, arguments: tuple[Any, ...]) -> bytes:
    body = xmlrpc.client.dumps(arguments, method).encode()
    place = urlsplit(uri)
    head = f"POST {place.path or '/'} HTTP/1.1\r\nHost: {place.netloc}\r\nConnection: close\r\n"
    return f"{head}Content-Type: text/xml\r\nContent-Length: {len(body)}\r\n\r\n".encode() + body


def encode_reply(value: Any) -> bytes:
    try:
        body = xmlrpc.client.dumps((value,), methodresponse=True).encode()
    except (OverflowError, TypeError) as error:
        body = xmlrpc.client.dumps(xmlrpc.client.Fault(1, str(error))).encode()
    return f"HTTP/1.1 200 OK\r\nContent-Type: text/xml\r\nContent-Length: {len(body)}\r\n\r\n".encode() + body


def decode_call(body: bytes) -> tuple[str, tuple[Any, ...]]:
    """The method and the arguments of an XML-RPC request. Raises `WireError`."""
    arguments, method = _loads(body)
    return method or "", arguments


def decode_reply(body: bytes) -> Any:
    """What a master's or a node's reply returns. Raises `Ros1Error` if it says that it failed, `WireError`."""
    match _loads(body)[0]:
        case ([int() as code, str() as text, value],):
            if code != SUCCESS:
                raise Ros1Error(text or "it failed")
            return value
    raise WireError("a reply that is not a code, a text and a value")


def _loads(body: bytes) -> tuple[tuple[Any, ...], str | None]:
    try:
        text = body.decode()  # the parser would also take UTF-16, in which the next check sees nothing
    except UnicodeDecodeError:
        raise WireError("an XML-RPC call that is not UTF-8") from None
    # Entities can expand to any size; no call needs a document type.
    if "<!" in text:
        raise WireError("an XML-RPC call with a document type")
    try:
        return xmlrpc.client.loads(text)
    except xmlrpc.client.Fault as error:
        raise Ros1Error(error.faultString[:300]) from None
    except Exception as error:  # whatever a parser of a stranger's text may raise
        raise WireError(f"no XML-RPC: {type(error).__name__}") from None


def place_of(uri: str) -> tuple[str, int]:
    """Host and port of the address of a master, a node (`http://`) or a service (`rosrpc://`). Raises `WireError`."""
    try:
        place = urlsplit(uri)
        if place.scheme in ("http", "rosrpc") and place.hostname and place.port:
            return place.hostname, place.port
    except ValueError:
        pass
    raise WireError(f"{uri[:100]!r} is no address of ROS 1")
