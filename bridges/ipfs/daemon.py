"""A client of an IPFS daemon's HTTP RPC: PubSub, content, the swarm."""

from __future__ import annotations

import asyncio
import math
from contextlib import asynccontextmanager
from typing import TYPE_CHECKING, Final, Self, TypeVar

import aiohttp
import msgspec

from bridges.ipfs.addresses import base_url, without_credentials
from bridges.ipfs.errors import (
    AccessDenied,
    DaemonRefused,
    DaemonUnreachable,
    NoPeers,
    PublishedOutOfOrder,
    PubSubDisabled,
)
from bridges.ipfs.pubsub import DaemonVersion, MultibaseDialect, PubsubDialect, PubsubMessage, dialect_of, lines_of
from mesh.errors import ClosedError

if TYPE_CHECKING:
    from collections.abc import AsyncGenerator, AsyncIterator
    from pathlib import Path

T = TypeVar("T")

CALL_TIMEOUT: Final = 15.0
"""Seconds for a call that transfers no content."""
CONNECT_TIMEOUT: Final = 5.0
PUBLISH_INTERVAL: Final = 0.02
"""Seconds between two messages to a Kubo. Since 0.40 a node drops a message that it validates after a later one of the
same origin, and it validates concurrently: of 1000 messages without a pause 9 were lost. 2 ms suffice on an idle
machine; this is for busy ones."""
LINE_LIMIT: Final = 2 * 1024 * 1024
"""Bytes of a subscription's line, at most: PubSub's own limit of 1 MiB in base64, with its envelope."""
RESPONSE_LIMIT: Final = 4 * 1024 * 1024
REASON_LIMIT: Final = 300
ADD_OPTIONS: Final = (
    ("cid-version", "0"),
    ("raw-leaves", "false"),
    ("chunker", "size-262144"),
    ("hash", "sha2-256"),
    ("max-file-links", "174"),
    ("trickle", "false"),
)
"""How files have been chunked and named since 2015. Stated in each call, because the daemon's defaults may be
configured otherwise since 2025. Daemons ignore options that they do not know."""


class _Refusal(msgspec.Struct):
    message: str = msgspec.field(default="", name="Message")


class _Strings(msgspec.Struct):
    strings: list[str] | None = msgspec.field(default=None, name="Strings")


class Identity(msgspec.Struct, frozen=True):
    """A daemon's peer id and addresses in the swarm."""

    id: str = msgspec.field(default="", name="ID")
    addresses: list[str] | None = msgspec.field(default=None, name="Addresses")


class _Added(msgspec.Struct):
    name: str = msgspec.field(name="Hash")


class _SwarmPeer(msgspec.Struct):
    peer: str = msgspec.field(name="Peer")


class _SwarmPeers(msgspec.Struct):
    peers: list[_SwarmPeer] | None = msgspec.field(default=None, name="Peers")


class Daemon:
    """The daemon at `api` (a multiaddr or a URL): `async with Daemon(api) as daemon`, then `detect_version`.

    `authorization` is the value of the `Authorization` header of a protected API; `call_timeout` is in seconds, for
    calls that transfer no content. Opening makes no call, so the daemon may start later. Every call raises
    `DaemonUnreachable` when the daemon does not answer in time, `DaemonRefused` with the daemon's message when it
    answers with an error, and `ClosedError` outside `async with`.
    """

    def __init__(self, api: str, *, authorization: str = "", call_timeout: float = CALL_TIMEOUT) -> None:
        self._base = base_url(api)
        self._call_timeout = call_timeout
        self._publishing = asyncio.Lock()
        self._published = -math.inf
        self.api: Final = without_credentials(self._base)
        self._headers = {"Authorization": authorization} if authorization else {}
        self._http: aiohttp.ClientSession | None = None
        self.version: DaemonVersion | None = None
        """The result of the last `detect_version`."""
        self._dialect: PubsubDialect = MultibaseDialect()

    async def __aenter__(self) -> Self:
        if self._http is not None:
            raise ClosedError("this daemon's client is already open")
        self._http = aiohttp.ClientSession(headers=self._headers)
        return self

    async def __aexit__(self, *exc_info: object) -> None:
        http, self._http = self._http, None
        if http is not None:
            await http.close()

    async def detect_version(self) -> DaemonVersion:
        """Ask for the daemon's version and use its dialect from now on. Call it after every reconnection."""
        self.version = await self._call("version", DaemonVersion)
        self._dialect = dialect_of(self.version)
        return self.version

    @property
    def dialect(self) -> str:
        """`multibase` or `plain`."""
        return self._dialect.name

    async def identity(self) -> Identity:
        """The daemon's peer id and addresses."""
        return await self._call("id", Identity)

    async def publish(self, topic: str, data: bytes) -> None:
        """Publish `data` on `topic`. Concurrent calls are serialized, and spaced for a Kubo.

        Raises `NoPeers` when the daemon reports that there are no listeners (not all do, see `listeners`), and
        `PublishedOutOfOrder` when the message must be published again: a Kubo since 0.40 numbers a message before
        validating it, and drops one that it validates after a higher number.
        """
        more, content = self._dialect.publication(data)
        form = None if content is None else _form(content)
        clock = asyncio.get_running_loop().time
        async with self._publishing:
            if self.version is not None and not self.version.is_js:
                await asyncio.sleep(self._published + PUBLISH_INTERVAL - clock())
            async with self._post("pubsub/pub", ("arg", self._dialect.topic(topic)), *more, body=form):
                self._published = clock()

    @asynccontextmanager
    async def subscribe(self, topic: str) -> AsyncGenerator[AsyncIterator[PubsubMessage | None]]:
        """Subscribe to `topic`: an iterator over its messages, this daemon's own included; None for an unreadable line.

        The subscription is active when the body begins. The iterator ends only by `DaemonUnreachable`, when the daemon
        ends the subscription.
        """
        arguments = (("arg", self._dialect.topic(topic)), *self._dialect.subscription)
        async with self._post("pubsub/sub", *arguments, timeout=math.inf) as answer:
            yield self._messages(answer)

    async def listeners(self, topic: str) -> list[str]:
        """The other nodes on `topic` that the daemon knows."""
        found = await self._call("pubsub/peers", _Strings, ("arg", self._dialect.topic(topic)))
        return found.strings or []

    async def swarm_peers(self) -> list[str]:
        """The peer ids of the nodes to which the daemon is connected."""
        found = await self._call("swarm/peers", _SwarmPeers)
        return [peer.peer for peer in found.peers or []]

    async def connect(self, address: str) -> None:
        """Connect to the node at a multiaddr that ends in `/p2p/` (or `/ipfs/`) and its peer id."""
        await self._call("swarm/connect", _Strings, ("arg", address))

    async def add(self, path: Path, *, timeout: float = CALL_TIMEOUT) -> str:
        """Add and pin a file with `ADD_OPTIONS`; returns the daemon's CID. Raises `OSError` when it can't be read."""
        with await asyncio.to_thread(path.open, "rb") as stream:
            form = aiohttp.FormData()
            form.add_field("file", stream, filename=path.name, content_type="application/octet-stream")
            added = await self._call(
                "add", _Added, *ADD_OPTIONS, ("pin", "true"), ("progress", "false"), body=form, timeout=timeout
            )
        return added.name

    async def put_block(self, data: bytes) -> None:
        """Put a block of a CIDv0 file, unpinned.

        A daemon that no longer knows the deprecated `format` returns another CID, but finds the block by its hash all
        the same.
        """
        await self._call("block/put", msgspec.Raw, ("format", "v0"), ("mhtype", "sha2-256"), body=_form(data))

    async def pin(self, cid: str, *, timeout: float = CALL_TIMEOUT) -> None:
        """Make the daemon fetch and keep a file. `timeout` is in seconds for the whole file."""
        await self._call("pin/add", msgspec.Raw, ("arg", cid), timeout=timeout)

    async def unpin(self, cid: str) -> None:
        """Unpin a file, so that the daemon may collect it."""
        await self._call("pin/rm", msgspec.Raw, ("arg", cid))

    async def block(self, cid: str, *, limit: int, timeout: float = CALL_TIMEOUT) -> bytes:
        """A block by its CID, unverified, which the daemon holds or finds within `timeout` seconds.

        Raises `DaemonRefused` when it does not find it, or when it has more than `limit` bytes.
        """
        async with self._post("block/get", ("arg", cid), timeout=timeout) as answer:
            return await self._read(answer, limit)

    async def _messages(self, answer: aiohttp.ClientResponse) -> AsyncIterator[PubsubMessage | None]:
        try:
            async for line in lines_of(answer.content.iter_any(), limit=LINE_LIMIT):
                try:
                    message = self._dialect.message(line)
                except ValueError:
                    yield None
                    continue
                if message is not None:
                    yield message
        except (aiohttp.ClientError, TimeoutError) as error:
            raise DaemonUnreachable(self.api, f"the subscription broke off: {_words(error)}") from error
        raise DaemonUnreachable(self.api, "the daemon ended the subscription")

    async def _call(
        self,
        call: str,
        kind: type[T],
        *arguments: tuple[str, str],
        body: aiohttp.FormData | None = None,
        timeout: float | None = None,
    ) -> T:
        async with self._post(call, *arguments, body=body, timeout=timeout) as answer:
            content = await self._read(answer, RESPONSE_LIMIT)
        try:
            return msgspec.json.decode(content, type=kind)
        except (msgspec.DecodeError, UnicodeDecodeError) as error:
            raise DaemonRefused(self.api, 200, f"unexpected answer to {call}: {error}") from None

    @asynccontextmanager
    async def _post(
        self,
        call: str,
        *arguments: tuple[str, str],
        body: aiohttp.FormData | None = None,
        timeout: float | None = None,
    ) -> AsyncGenerator[aiohttp.ClientResponse]:
        """The successful response to a call; other responses raise.

        `timeout` is in seconds for the whole response, by default `call_timeout`. With an infinite one the response
        must still begin within `call_timeout`, because a frozen daemon accepts connections but never answers.
        """
        if self._http is None:
            raise ClosedError("the client of the IPFS daemon is not open", hint="use it inside `async with`")
        url = f"{self._base}/api/v0/{call}"
        total = self._call_timeout if timeout is None else timeout
        limits = aiohttp.ClientTimeout(total=None if total == math.inf else total, connect=CONNECT_TIMEOUT)
        try:
            async with asyncio.timeout(self._call_timeout if total == math.inf else None):
                answer = await self._http.post(url, params=arguments, data=body, timeout=limits, allow_redirects=False)
        except (aiohttp.ClientError, TimeoutError) as error:
            raise DaemonUnreachable(self.api, f"{call}: {_words(error)}") from error
        async with answer:
            if answer.status != 200:
                raise self._refused(answer.status, await self._read(answer, RESPONSE_LIMIT))
            yield answer

    async def _read(self, answer: aiohttp.ClientResponse, limit: int) -> bytes:
        content = bytearray()
        try:
            async for chunk in answer.content.iter_any():
                content += chunk
                if len(content) > limit:
                    raise DaemonRefused(self.api, answer.status, f"an answer of more than {limit} bytes")
        except (aiohttp.ClientError, TimeoutError) as error:
            raise DaemonUnreachable(self.api, f"the answer broke off: {_words(error)}") from error
        return bytes(content)

    def _refused(self, status: int, content: bytes) -> DaemonRefused:
        try:
            why = msgspec.json.decode(content, type=_Refusal).message
        except (msgspec.DecodeError, UnicodeDecodeError):
            why = content.decode(errors="replace").strip()
        why = why[:REASON_LIMIT] or f"HTTP {status}"
        if status in (401, 403):
            return AccessDenied(self.api, status, why)
        if "InsufficientPeers" in why:
            return NoPeers(self.api, status, why)
        if "validation ignored" in why:
            return PublishedOutOfOrder(self.api, status, why)
        if "pubsub" in why.lower() and "not enabled" in why.lower():
            return PubSubDisabled(self.api, status, why)
        return DaemonRefused(self.api, status, why)


def _form(content: bytes) -> aiohttp.FormData:
    form = aiohttp.FormData()
    form.add_field("file", content, filename="data", content_type="application/octet-stream")
    return form


def _words(error: BaseException) -> str:
    return str(error) or type(error).__name__
