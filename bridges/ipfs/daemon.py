"""An IPFS daemon by its HTTP RPC: publishing, subscribing, content, the swarm."""

from __future__ import annotations

import asyncio
import math
from contextlib import asynccontextmanager
from typing import TYPE_CHECKING, Final, Self, TypeVar

import aiohttp
import msgspec

from bridges.ipfs.addresses import base_url, without_credentials
from bridges.ipfs.dialects import Dialect, Event, Multibase, Version, dialect_of
from bridges.ipfs.errors import AccessDenied, DaemonRefused, DaemonUnreachable, NoPeers, Overtaken, PubSubDisabled
from bridges.ipfs.lines import lines_of
from mesh.errors import ClosedError

if TYPE_CHECKING:
    from collections.abc import AsyncGenerator, AsyncIterator
    from pathlib import Path
    from types import TracebackType

T = TypeVar("T")

CALL_TIMEOUT: Final = 15.0
"""Seconds for a call that only asks or tells."""
CONNECT_TIMEOUT: Final = 5.0
SPACING: Final = 0.02
"""Seconds from one message to the next at a Kubo. Since 0.40 each node drops a message that it checks after a later one
of the same origin, and it checks as many at once as it has cores: of 1000 that came without a pause 9 were lost. Where
nothing else is done 2 ms are enough; this is for busy machines."""
LONGEST_LINE: Final = 2 * 1024 * 1024
"""Bytes of the longest line of a subscription: PubSub's own limit of 1 MiB, in base64 and with its envelope."""
LONGEST_ANSWER: Final = 4 * 1024 * 1024
LONGEST_REASON: Final = 300
SETTINGS: Final = (
    ("cid-version", "0"),
    ("raw-leaves", "false"),
    ("chunker", "size-262144"),
    ("hash", "sha2-256"),
    ("max-file-links", "174"),
    ("trickle", "false"),
)
"""How files have been chunked and named since 2015. Never left to the daemon: its own are about to change, and a
Kubo of 2025 and later may be configured otherwise. Daemons that do not know one of them pass it over."""


class _Refusal(msgspec.Struct):
    message: str = msgspec.field(default="", name="Message")


class _Strings(msgspec.Struct):
    strings: list[str] | None = msgspec.field(default=None, name="Strings")


class Identity(msgspec.Struct, frozen=True):
    """Who a daemon is in the swarm, and its addresses."""

    id: str = msgspec.field(default="", name="ID")
    addresses: list[str] | None = msgspec.field(default=None, name="Addresses")


class _Added(msgspec.Struct):
    name: str = msgspec.field(name="Hash")


class _SwarmPeer(msgspec.Struct):
    peer: str = msgspec.field(name="Peer")


class _SwarmPeers(msgspec.Struct):
    peers: list[_SwarmPeer] | None = msgspec.field(default=None, name="Peers")


class Daemon:
    """The daemon at `api` (a multiaddr or a URL): `async with Daemon(api) as daemon`, then `greet`.

    `authorization` is the value of the `Authorization` header that a protected API wants; `patience` is the time in
    seconds for a call that only asks or tells. Opening asks nothing of the daemon, which may come later. Every call
    raises `DaemonUnreachable` when it is not there or does not answer within its time, `DaemonRefused` with its own
    words when it says no, and `ClosedError` outside `async with`.
    """

    def __init__(self, api: str, *, authorization: str = "", patience: float = CALL_TIMEOUT) -> None:
        self._base = base_url(api)
        self._patience = patience
        self._publishing = asyncio.Lock()
        self._published = -math.inf
        self.api: Final = without_credentials(self._base)
        self._headers = {"Authorization": authorization} if authorization else {}
        self._http: aiohttp.ClientSession | None = None
        self.version: Version | None = None
        """What the daemon said it is when it was last greeted."""
        self._dialect: Dialect = Multibase()

    async def __aenter__(self) -> Self:
        if self._http is not None:
            raise ClosedError("this daemon's client is open already")
        self._http = aiohttp.ClientSession(headers=self._headers)
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        http, self._http = self._http, None
        if http is not None:
            await http.close()

    async def greet(self) -> Version:
        """Ask what the daemon is, and speak its dialect from now on. After every loss: it may be another one."""
        self.version = await self._ask("version", Version)
        self._dialect = dialect_of(self.version)
        return self.version

    @property
    def dialect(self) -> str:
        """`multibase` or `plain`."""
        return self._dialect.name

    async def identity(self) -> Identity:
        """Who the daemon is in the swarm."""
        return await self._ask("id", Identity)

    async def publish(self, topic: str, data: bytes) -> None:
        """Publish `data` on `topic`, one after the other whatever the topics, and not faster than nodes check them.

        Raises `NoPeers` when the daemon says that nobody would hear it. Others do not say so: see `listeners`.
        Raises `Overtaken` when it is to be published again: a Kubo since 0.40 numbers a message first and checks it
        later, and takes none that is checked after one with a higher number.
        """
        more, content = self._dialect.publication(data)
        form = None if content is None else _form(content)
        clock = asyncio.get_running_loop().time
        async with self._publishing:
            if self.version is not None and not self.version.is_js:
                await asyncio.sleep(self._published + SPACING - clock())
            async with self._post("pubsub/pub", ("arg", self._dialect.topic(topic)), *more, body=form):
                self._published = clock()

    @asynccontextmanager
    async def subscribe(self, topic: str) -> AsyncGenerator[AsyncIterator[Event | None]]:
        """What is said on `topic` from now on, by this daemon too; None for a line that can't be read.

        The subscription stands when the body begins. Its iterator raises `DaemonUnreachable` when the daemon breaks it
        off; there is no other end.
        """
        arguments = (("arg", self._dialect.topic(topic)), *self._dialect.subscription)
        async with self._post("pubsub/sub", *arguments, timeout=math.inf) as answer:
            yield self._events(answer)

    async def listeners(self, topic: str) -> list[str]:
        """The other nodes which this one knows to listen to `topic`."""
        found = await self._ask("pubsub/peers", _Strings, ("arg", self._dialect.topic(topic)))
        return found.strings or []

    async def neighbours(self) -> list[str]:
        """The nodes to which this one is connected."""
        found = await self._ask("swarm/peers", _SwarmPeers)
        return [peer.peer for peer in found.peers or []]

    async def connect(self, address: str) -> None:
        """Connect to the node at a multiaddr that ends in `/p2p/` (or `/ipfs/`) and its identity."""
        await self._ask("swarm/connect", _Strings, ("arg", address))

    async def add(self, path: Path, *, timeout: float = CALL_TIMEOUT) -> str:
        """Add and pin a file, with `SETTINGS`; the CID is the daemon's. Raises `OSError` when it can't be read."""
        with await asyncio.to_thread(path.open, "rb") as stream:
            form = aiohttp.FormData()
            form.add_field("file", stream, filename=path.name, content_type="application/octet-stream")
            added = await self._ask(
                "add", _Added, *SETTINGS, ("pin", "true"), ("progress", "false"), body=form, timeout=timeout
            )
        return added.name

    async def put_block(self, data: bytes) -> None:
        """Give the daemon a block of a file with a CIDv0, not pinned.

        A daemon finds its blocks by their hash, so that one in which `format` has gone the way of all deprecated
        options gives it another name, and has it under the right one too.
        """
        await self._ask("block/put", msgspec.Raw, ("format", "v0"), ("mhtype", "sha2-256"), body=_form(data))

    async def pin(self, cid: str, *, timeout: float = CALL_TIMEOUT) -> None:
        """Have the daemon fetch a file and keep it. `timeout` in seconds is for all of it."""
        await self._ask("pin/add", msgspec.Raw, ("arg", cid), timeout=timeout)

    async def unpin(self, cid: str) -> None:
        """Let the daemon forget a file that was pinned, when it next tidies up."""
        await self._ask("pin/rm", msgspec.Raw, ("arg", cid))

    async def block(self, cid: str, *, limit: int, timeout: float = CALL_TIMEOUT) -> bytes:
        """A block by its name, unchecked, as the daemon has it or finds it within `timeout` seconds.

        Raises `DaemonRefused` when it does not find it or it is of more than `limit` bytes.
        """
        async with self._post("block/get", ("arg", cid), timeout=timeout) as answer:
            return await self._read(answer, limit)

    async def _events(self, answer: aiohttp.ClientResponse) -> AsyncIterator[Event | None]:
        try:
            async for line in lines_of(answer.content.iter_any(), limit=LONGEST_LINE):
                try:
                    event = self._dialect.event(line)
                except ValueError:
                    yield None
                    continue
                if event is not None:
                    yield event
        except (aiohttp.ClientError, TimeoutError) as error:
            raise DaemonUnreachable(self.api, f"the subscription broke off: {_words(error)}") from error
        raise DaemonUnreachable(self.api, "the daemon ended the subscription")

    async def _ask(
        self,
        call: str,
        kind: type[T],
        *arguments: tuple[str, str],
        body: aiohttp.FormData | None = None,
        timeout: float | None = None,
    ) -> T:
        async with self._post(call, *arguments, body=body, timeout=timeout) as answer:
            content = await self._read(answer, LONGEST_ANSWER)
        try:
            return msgspec.json.decode(content, type=kind)
        except (msgspec.DecodeError, UnicodeDecodeError) as error:
            raise DaemonRefused(self.api, 200, f"its answer to {call} is not what it should be: {error}") from None

    @asynccontextmanager
    async def _post(
        self,
        call: str,
        *arguments: tuple[str, str],
        body: aiohttp.FormData | None = None,
        timeout: float | None = None,
    ) -> AsyncGenerator[aiohttp.ClientResponse]:
        """The answer to a call, if it is a good one. Errors of the body are the body's.

        `timeout` is in seconds for all of it, by default the daemon's patience; one that is infinite is for the body
        only: a frozen daemon still takes connections, and never begins to answer.
        """
        if self._http is None:
            raise ClosedError("the client of the IPFS daemon is not open", hint="use it inside `async with`")
        url = f"{self._base}/api/v0/{call}"
        total = self._patience if timeout is None else timeout
        limits = aiohttp.ClientTimeout(total=None if total == math.inf else total, connect=CONNECT_TIMEOUT)
        try:
            async with asyncio.timeout(self._patience if total == math.inf else None):
                answer = await self._http.post(url, params=arguments, data=body, timeout=limits, allow_redirects=False)
        except (aiohttp.ClientError, TimeoutError) as error:
            raise DaemonUnreachable(self.api, f"{call}: {_words(error)}") from error
        async with answer:
            if answer.status != 200:
                raise self._refused(answer.status, await self._read(answer, LONGEST_ANSWER))
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
        why = why[:LONGEST_REASON] or f"HTTP {status}"
        if status in (401, 403):
            return AccessDenied(self.api, status, why)
        if "InsufficientPeers" in why:
            return NoPeers(self.api, status, why)
        if "validation ignored" in why:
            return Overtaken(self.api, status, why)
        if "pubsub" in why.lower() and "not enabled" in why.lower():
            return PubSubDisabled(self.api, status, why)
        return DaemonRefused(self.api, status, why)


def _form(content: bytes) -> aiohttp.FormData:
    form = aiohttp.FormData()
    form.add_field("file", content, filename="data", content_type="application/octet-stream")
    return form


def _words(error: BaseException) -> str:
    return str(error) or type(error).__name__
