"""An IPFS daemon: its errors, its address, the two dialects of its PubSub, a client of its HTTP RPC, and its checks for
`aira doctor`.

Since go-ipfs 0.11 and ipfs-core 0.13 (both December 2021) topics and data are multibase texts, and published data is a
multipart file, because the older dialect broke topics and data that contain a line feed. Sources: the changelogs of
go-ipfs 0.11.0 and ipfs-core 0.13.0, and `core/commands/pubsub.go` of go-ipfs 0.4.18.
"""

from __future__ import annotations

import asyncio
import binascii
import math
import re
from base64 import b64decode, urlsafe_b64encode
from contextlib import asynccontextmanager
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Final, NamedTuple, TypeVar
from urllib.parse import urlsplit

import aiohttp
import msgspec

from mesh.base.lifecycle import Lifecycle
from mesh.errors import ConfigurationError, RemoteError
from mesh.ops.doctor.checks import Check, CheckResult, passed, warning
from schemas.decoding import InvalidData, decode_json, text_of

if TYPE_CHECKING:
    from collections.abc import AsyncGenerator, AsyncIterable, AsyncIterator
    from contextlib import AsyncExitStack

    from mesh.ops.doctor.checks import DoctorContext
    from mesh.settings import IpfsSettings, Settings


class IpfsError(RemoteError, code="daemon-refused"):
    """An IPFS daemon or gateway answered a call with an error, or (`daemon-unreachable`) not at all.

    `no-peers`: it knows no other subscriber of the topic; keep the message and publish it later.
    `published-out-of-order`: it validated a later message of its own first, and dropped this one as a replay; publish
    it again.
    """

    def __init__(self, api: str, why: str, *, hint: str = "", code: str = "") -> None:
        super().__init__(f"IPFS at {api}: {why}", hint=hint, code=code)


def unreachable(
    api: str, why: str | BaseException, *, hint: str = "is the daemon running, and is this the address of its RPC?"
) -> IpfsError:
    """The error for a daemon or gateway that does not answer, or whose connection broke; it may be back later."""
    return IpfsError(api, str(why) or type(why).__name__, hint=hint, code="daemon-unreachable")


async def read_answer(answer: aiohttp.ClientResponse, api: str, limit: int) -> bytes:
    """The body of an answer. Raises `IpfsError`, also for more than `limit` bytes."""
    content = bytearray()
    try:
        async for chunk in answer.content.iter_any():
            content += chunk
            if len(content) > limit:
                raise IpfsError(api, f"an answer of more than {limit} bytes")
    except (aiohttp.ClientError, TimeoutError) as error:
        raise unreachable(api, f"the answer broke off: {_words(error)}") from error
    return bytes(content)


def _words(error: BaseException) -> str:
    return str(error) or type(error).__name__


_HINT: Final = "write it as /ip4/127.0.0.1/tcp/5001 or http://127.0.0.1:5001"
_HOSTS: Final = ("ip4", "ip6", "dns", "dns4", "dns6", "dnsaddr")


def base_url(text: str) -> str:
    """The URL for `text`, which is a URL or a multiaddr, without a trailing slash.

    Multiaddrs look like `/ip4/127.0.0.1/tcp/5001`, optionally followed by `/http`, `/https` or `/tls/http`. Raises
    `ConfigurationError`.
    """
    url = _of_multiaddr(text) if text.startswith("/") else text
    try:
        parts = urlsplit(url)
        usable = parts.scheme in ("http", "https") and bool(parts.hostname) and parts.port != 0
    except ValueError:  # an invalid port, or an unclosed bracket
        usable = False
    if not usable or parts.query or parts.fragment:
        raise ConfigurationError(f"{text!r} is not the address of an IPFS daemon or gateway", hint=_HINT)
    return url.rstrip("/")


def without_credentials(url: str) -> str:
    """The URL without user name and password, for display."""
    scheme, _, rest = url.partition("://")
    return f"{scheme}://{rest.rpartition('@')[2]}"


def _of_multiaddr(text: str) -> str:
    match text.rstrip("/").split("/")[1:]:
        case [kind, host, "tcp", port, *rest] if kind in _HOSTS and host and _is_port(port):
            scheme = {(): "http", ("http",): "http", ("https",): "https", ("tls", "http"): "https"}.get(tuple(rest))
            if scheme is not None:
                return f"{scheme}://{f'[{host}]' if kind == 'ip6' else host}:{port}"
    raise ConfigurationError(f"{text!r} is not a multiaddr of an IPFS daemon's RPC", hint=_HINT)


def _is_port(text: str) -> bool:
    return text.isascii() and text.isdigit() and 0 < int(text) <= 65_535


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
        return f"{'go-ipfs' if _numbers(self.version) < (0, 14) else 'kubo'} {self.version or 'unknown'}"


class PubsubMessage(NamedTuple):
    """A message received on a topic: its publisher, as the daemon writes it, and the data."""

    sender: str
    data: bytes


class _SubscriptionLine(msgspec.Struct):
    """A line of a subscription. The first line of js-ipfs is `{}`."""

    sender: str = msgspec.field(default="", name="from")
    data: str | None = None


class PubsubDialect:
    """How a daemon encodes topics and data: plainly, before December 2021; received data is base64."""

    name = "plain"
    subscription: tuple[tuple[str, str], ...] = (("discover", "true"),)
    """The arguments of a subscription besides the topic."""

    def topic(self, topic: str) -> str:
        """The topic as a call's argument."""
        return topic

    def publication(self, data: bytes) -> tuple[list[tuple[str, str]], bytes | None]:
        """How to publish data: further arguments of the call, and the content of its file, if it has one.

        Raises `UnicodeDecodeError` (a `ValueError`), if an argument can't be this text.
        """
        return [("arg", data.decode())], None

    def message(self, line: bytes) -> PubsubMessage | None:
        """The message in a line of a subscription; None for a line without one. Raises `ValueError`."""
        try:
            decoded = decode_json(line, _SubscriptionLine)
        except InvalidData as error:
            raise ValueError(f"not a line of a subscription: {error}") from None
        if decoded.data is None:
            return None
        try:
            return PubsubMessage(decoded.sender, self._data(decoded.data))
        except binascii.Error as error:
            raise ValueError(f"the data is not base64: {error}") from None

    def _data(self, text: str) -> bytes:
        return b64decode(text, validate=True)


class MultibaseDialect(PubsubDialect):
    """The current dialect: topics and data are base64url without padding, prefixed with `u`."""

    name = "multibase"
    subscription = ()

    def topic(self, topic: str) -> str:
        return "u" + urlsafe_b64encode(topic.encode()).rstrip(b"=").decode()

    def publication(self, data: bytes) -> tuple[list[tuple[str, str]], bytes | None]:
        return [], data

    def _data(self, text: str) -> bytes:
        if not text.startswith("u"):
            raise ValueError(f"the data is in multibase {text[:1]!r}, not in base64url")
        return b64decode(text[1:] + "=" * (-len(text[1:]) % 4), altchars=b"-_", validate=True)


def dialect_of(version: DaemonVersion) -> PubsubDialect:
    """The dialect of a daemon of that version; the current one if the version is unreadable."""
    if version.js_core:
        return PubsubDialect() if _numbers(version.js_core) < (0, 13) else MultibaseDialect()
    if version.js_interface:  # js-ipfs did not report its core before 2020
        return PubsubDialect()
    return PubsubDialect() if _numbers(version.version) < (0, 11) else MultibaseDialect()


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
    found = re.search(r"(\d+)\.(\d+)", text)
    return (int(found[1]), int(found[2])) if found else (9999, 0)  # an unreadable version counts as a recent one


T = TypeVar("T")


class DaemonLimits(NamedTuple):
    """How a daemon is asked."""

    call: float = 15.0
    """Seconds for a call that transfers no content."""
    answer: int = 4 * 1024 * 1024
    """Bytes of an answer."""
    publish: float = 0.02
    """Seconds between two messages to a Kubo. Since 0.40 a node drops a message that it validates after a later one of
    the same origin, and it validates concurrently: of 1000 messages without a pause 9 were lost. 2 ms suffice on an
    idle machine; this is for busy ones."""


DAEMON_LIMITS: Final = DaemonLimits()
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


class _Peer(msgspec.Struct):
    id: str = msgspec.field(name="Peer")


class _DaemonAnswer(msgspec.Struct):
    """What the daemon answers to a call: each has some of these fields."""

    message: str = msgspec.field(default="", name="Message")
    id: str = msgspec.field(default="", name="ID")
    hash: str = msgspec.field(default="", name="Hash")
    strings: list[str] | None = msgspec.field(default=None, name="Strings")
    peers: list[_Peer] | None = msgspec.field(default=None, name="Peers")


class Daemon(Lifecycle):
    """The daemon at `api` (a multiaddr or a URL): `async with Daemon(api) as daemon`, then `detect_version`.

    `authorization` is the value of the `Authorization` header of a protected API; `call_timeout` is in seconds, for
    calls that transfer no content. Opening makes no call, so the daemon may start later. Every call raises `IpfsError`:
    with the daemon's message when it answers with an error, and `daemon-unreachable` when it does not answer in time.
    """

    title = "client of an IPFS daemon"

    def __init__(self, api: str, *, authorization: str = "", call_timeout: float = DAEMON_LIMITS.call) -> None:
        self._base = base_url(api)
        self._call_timeout = call_timeout
        self._publishing = asyncio.Lock()
        self._published = -math.inf
        self.api: Final = without_credentials(self._base)
        self._headers = {"Authorization": authorization} if authorization else {}
        self.version: DaemonVersion | None = None
        """The result of the last `detect_version`."""
        self._dialect: PubsubDialect = MultibaseDialect()

    async def _open(self, stack: AsyncExitStack) -> None:
        self._http = await stack.enter_async_context(aiohttp.ClientSession(headers=self._headers))

    async def detect_version(self) -> DaemonVersion:
        """Ask for the daemon's version and use its dialect from now on. Call it after every reconnection."""
        self.version = await self._call("version", DaemonVersion)
        self._dialect = dialect_of(self.version)
        return self.version

    @property
    def dialect(self) -> str:
        """`multibase` or `plain`."""
        return self._dialect.name

    async def identity(self) -> str:
        return (await self._call("id", _DaemonAnswer)).id

    async def publish(self, topic: str, data: bytes) -> None:
        """Publish `data` on `topic`. Concurrent calls are serialized, and spaced for a Kubo.

        Raises `IpfsError`: `no-peers` when the daemon reports that there are no listeners (not all do, see
        `listeners`), `published-out-of-order` when the message must be published again: a Kubo since 0.40 numbers a
        message before validating it, and drops one that it validates after a higher number.
        """
        more, content = self._dialect.publication(data)
        form = None if content is None else _form(content)
        clock = asyncio.get_running_loop().time
        async with self._publishing:
            if self.version is not None and not self.version.is_js:
                await asyncio.sleep(self._published + DAEMON_LIMITS.publish - clock())
            async with self._post("pubsub/pub", ("arg", self._dialect.topic(topic)), *more, body=form):
                self._published = clock()

    @asynccontextmanager
    async def subscribe(self, topic: str) -> AsyncGenerator[AsyncIterator[PubsubMessage | None]]:
        """Subscribe to `topic`: an iterator over its messages, this daemon's own included; None for an unreadable line.

        The subscription is active when the body begins. The iterator ends only by `IpfsError`, when the daemon ends
        the subscription.
        """
        arguments = (("arg", self._dialect.topic(topic)), *self._dialect.subscription)
        async with self._post("pubsub/sub", *arguments, timeout=math.inf) as answer:
            yield self._messages(answer)

    async def listeners(self, topic: str) -> list[str]:
        """The other nodes on `topic` that the daemon knows."""
        found = await self._call("pubsub/peers", _DaemonAnswer, ("arg", self._dialect.topic(topic)))
        return found.strings or []

    async def swarm_peers(self) -> list[str]:
        found = await self._call("swarm/peers", _DaemonAnswer)
        return [peer.id for peer in found.peers or []]

    async def connect(self, address: str) -> None:
        """Connect to the node at a multiaddr that ends in `/p2p/` (or `/ipfs/`) and its peer id."""
        await self._call("swarm/connect", _DaemonAnswer, ("arg", address))

    async def add(self, path: Path, *, timeout: float = DAEMON_LIMITS.call) -> str:
        """Add and pin a file with `ADD_OPTIONS`; returns the daemon's CID. Raises `OSError` when it can't be read."""
        with path.open("rb") as stream:
            form = aiohttp.FormData()
            form.add_field("file", stream, filename=path.name, content_type="application/octet-stream")
            added = await self._call(
                "add", _DaemonAnswer, *ADD_OPTIONS, ("pin", "true"), ("progress", "false"), body=form, timeout=timeout
            )
        if not added.hash:
            raise IpfsError(self.api, "an answer to add without a hash")
        return added.hash

    async def put_block(self, data: bytes) -> None:
        """Put a block of a CIDv0 file, unpinned.

        A daemon that no longer knows the deprecated `format` returns another CID, but finds the block by its hash all
        the same.
        """
        await self._call("block/put", msgspec.Raw, ("format", "v0"), ("mhtype", "sha2-256"), body=_form(data))

    async def pin(self, cid: str, *, timeout: float = DAEMON_LIMITS.call) -> None:
        """Make the daemon fetch and keep a file. `timeout` is in seconds for the whole file."""
        await self._call("pin/add", msgspec.Raw, ("arg", cid), timeout=timeout)

    async def unpin(self, cid: str) -> None:
        await self._call("pin/rm", msgspec.Raw, ("arg", cid))

    async def block(self, cid: str, *, limit: int, timeout: float = DAEMON_LIMITS.call) -> bytes:
        """A block by its CID, unverified, which the daemon holds or finds within `timeout` seconds.

        Raises `IpfsError` when it does not find it, or when it has more than `limit` bytes.
        """
        async with self._post("block/get", ("arg", cid), timeout=timeout) as answer:
            return await read_answer(answer, self.api, limit)

    async def _messages(self, answer: aiohttp.ClientResponse) -> AsyncIterator[PubsubMessage | None]:
        try:
            # PubSub's own limit of 1 MiB in base64, with its envelope
            async for line in lines_of(answer.content.iter_any(), limit=2 * 1024 * 1024):
                try:
                    message = self._dialect.message(line)
                except ValueError:
                    yield None
                    continue
                if message is not None:
                    yield message
        except (aiohttp.ClientError, TimeoutError) as error:
            raise unreachable(self.api, f"the subscription broke off: {_words(error)}") from error
        raise unreachable(self.api, "the daemon ended the subscription")

    async def _call(
        self,
        call: str,
        kind: type[T],
        *arguments: tuple[str, str],
        body: aiohttp.FormData | None = None,
        timeout: float | None = None,
    ) -> T:
        async with self._post(call, *arguments, body=body, timeout=timeout) as answer:
            content = await read_answer(answer, self.api, DAEMON_LIMITS.answer)
        try:
            return decode_json(content, kind)
        except InvalidData as error:
            raise IpfsError(self.api, f"unexpected answer to {call}: {error}") from None

    @asynccontextmanager
    async def _post(
        self, call: str, *arguments: tuple[str, str], body: aiohttp.FormData | None = None, timeout: float | None = None
    ) -> AsyncGenerator[aiohttp.ClientResponse]:
        """The successful response to a call; other responses raise.

        `timeout` is in seconds for the whole response, by default `call_timeout`. With an infinite one the response
        must still begin within `call_timeout`, because a frozen daemon accepts connections but never answers.
        """
        self.check_open()
        url = f"{self._base}/api/v0/{call}"
        total = self._call_timeout if timeout is None else timeout
        limits = aiohttp.ClientTimeout(total=None if total == math.inf else total, connect=5.0)
        try:
            async with asyncio.timeout(self._call_timeout if total == math.inf else None):
                answer = await self._http.post(url, params=arguments, data=body, timeout=limits, allow_redirects=False)
        except (aiohttp.ClientError, TimeoutError) as error:
            raise unreachable(self.api, f"{call}: {_words(error)}") from error
        async with answer:
            if answer.status != 200:
                raise self._refused(answer.status, await read_answer(answer, self.api, DAEMON_LIMITS.answer))
            yield answer

    def _refused(self, status: int, content: bytes) -> IpfsError:
        try:
            why = decode_json(content, _DaemonAnswer).message
        except InvalidData:
            why = content.decode(errors="replace").strip()
        why = why[:300] or f"HTTP {status}"
        if status in (401, 403):
            hint = (
                "put the value of the Authorization header into a file and pass --ipfs-authorization-file; it must"
                " allow version, id, pubsub, swarm, add, block and pin below /api/v0/"
            )
            return IpfsError(self.api, why, code="access-denied", hint=hint)
        if "InsufficientPeers" in why:
            return IpfsError(self.api, why, code="no-peers")
        if "validation ignored" in why:
            return IpfsError(self.api, why, code="published-out-of-order")
        if "pubsub" in why.lower() and "not enabled" in why.lower():
            hint = "ipfs config --json Pubsub.Enabled true; old ones: --enable-pubsub-experiment"
            return IpfsError(self.api, why, code="pubsub-disabled", hint=hint)
        return IpfsError(self.api, why)


def _form(content: bytes) -> aiohttp.FormData:
    form = aiohttp.FormData()
    form.add_field("file", content, filename="data", content_type="application/octet-stream")
    return form


def authorization_of(settings: IpfsSettings) -> str:
    """The daemon's `Authorization` header, empty if it needs none. Raises `ConfigurationError`."""
    if not settings.ipfs_authorization_file:
        return ""
    path = Path(settings.ipfs_authorization_file).expanduser()
    try:
        value = text_of(path.read_bytes()).strip()
    except (OSError, InvalidData) as error:
        raise ConfigurationError(f"can't read the IPFS credentials in {path}: {error}") from None
    if not value.isascii() or not value.isprintable():
        raise ConfigurationError(
            f"{path} does not hold the value of a header", hint="one line, such as Bearer … or Basic …"
        )
    return value


def checks(context: DoctorContext) -> list[Check]:
    """The checks of the daemon (entry point `aira.doctor_checks`)."""
    settings = context.settings
    daemon = Check("ipfs daemon", partial(check_daemon, settings))
    needs = ((daemon,),)
    return [
        daemon,
        Check("ipfs pubsub", partial(check_pubsub, settings), needs=needs),
        Check("ipfs swarm", partial(check_swarm, settings), needs=needs),
    ]


async def check_daemon(settings: IpfsSettings) -> CheckResult:
    """Whether it answers and accepts our credentials. Raises `IpfsError`, `ConfigurationError`."""
    async with _connected(settings) as daemon:
        return passed(f"{daemon.version} at {daemon.api}, with the {daemon.dialect} API")


async def check_pubsub(settings: Settings) -> CheckResult:
    """Whether PubSub is enabled, and how many others subscribe to the lighthouse's topic. Raises `IpfsError`."""
    async with _connected(settings) as daemon:
        topic = settings.lighthouse_contract
        listeners = len(await daemon.listeners(topic))
        return passed(f"enabled; {listeners} other subscriber{'' if listeners == 1 else 's'} of {topic}")


async def check_swarm(settings: IpfsSettings) -> CheckResult:
    async with _connected(settings) as daemon:
        count = len(await daemon.swarm_peers())
        if not count:
            return warning(
                "the daemon has no peers, so its messages reach no other node",
                code="no-peers",
                hint="name legacy nodes with --ipfs-swarm-connect /…/p2p/ID, or give the daemon internet access",
            )
        return passed(f"connected to {count} peer{'' if count == 1 else 's'}")


@asynccontextmanager
async def _connected(settings: IpfsSettings) -> AsyncIterator[Daemon]:
    authorization = authorization_of(settings)
    async with Daemon(settings.ipfs_http_provider, authorization=authorization, call_timeout=4.0) as daemon:
        await daemon.detect_version()
        yield daemon
