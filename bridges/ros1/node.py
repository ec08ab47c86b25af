"""A node of ROS 1 in an event loop: topics, services, and the slave API by which a master and other nodes reach it.

What strangers send is bounded in size, number and time (`wire`, `mesh.base.door`). A subscriber that does not read
loses messages, and holds up nobody else.
"""

from __future__ import annotations

import asyncio
import logging
import os
import time
from contextlib import suppress
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Final, NamedTuple, TypeAlias

from bridges.ros1._wire import (
    ERROR,
    FAILURE,
    SUCCESS,
    WIRE_LIMITS,
    Frames,
    Ros1Error,
    WireError,
    decode_call,
    decode_header,
    decode_reply,
    encode_call,
    encode_header,
    encode_reply,
    frame,
    http_length,
    length_of,
    place_of,
    resolve,
    stays_open,
)
from mesh.base.background import Background
from mesh.base.door import Door, DoorLimits
from mesh.base.flood import Drops
from mesh.base.lifecycle import Lifecycle
from mesh.base.log_context import log_event
from mesh.base.outage_log import OutageLog
from mesh.base.retry import Backoff, RetryPolicy
from mesh.errors import AiraError, PortUnavailable
from schemas.errors import InvalidPayload

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Iterable, Mapping
    from contextlib import AsyncExitStack

    from bridges.ros1.messages import Ros1ServiceType, Ros1Type
    from mesh.base.door import Guest

    Handler = Callable[[dict[str, Any], str], Awaitable[Mapping[str, Any]]]
    Received = Callable[[bytes, Mapping[str, str]], None]
    Dispatch = Callable[[str, tuple[Any, ...]], Awaitable[tuple[int, str, Any]]]

log = logging.getLogger(__name__)

LIMITS: Final = DoorLimits(connections=512, per_address=512)
"""Connections of a node or a master at once: all nodes of a machine have one address."""


class Ros1NodeLimits(NamedTuple):
    """How long a node waits for others, and what it keeps for them."""

    waiting: int = 8 << 20
    """Bytes that wait for a slow subscriber, after which it loses messages. One message may be larger."""
    call: float = 5.0
    """Seconds for a call of a master or a node."""
    check: float = 1.0
    """Seconds between two looks at whether the master still knows us, and at connections that said nothing in time."""


ROS1_NODE_LIMITS: Final = Ros1NodeLimits()
RECONNECT: Final = RetryPolicy(initial=0.2, ceiling=5.0)
ANY: Final = "*"
"""The MD5 sum, or the type, of whoever takes any."""
TCPROS: Final = "TCPROS"


async def call_api(uri: str, method: str, *arguments: Any) -> Any:
    """Call the XML-RPC API of a master or a node; returns the value of its reply. Raises `Ros1Error`."""
    host, port = place_of(uri)
    writer = None
    try:
        async with asyncio.timeout(ROS1_NODE_LIMITS.call):
            reader, writer = await asyncio.open_connection(host, port, limit=WIRE_LIMITS.head)
            writer.write(encode_call(uri, method, arguments))
            head = await reader.readuntil(b"\r\n\r\n")
            return decode_reply(await reader.readexactly(http_length(head)))
    except WireError:
        raise Ros1Error(f"{uri} is no program of ROS 1", code="ros1-unreachable") from None
    except (OSError, EOFError, asyncio.LimitOverrunError) as error:
        raise Ros1Error(f"{uri} does not answer: {_reason(error)}", code="ros1-unreachable") from None
    finally:
        if writer is not None:
            writer.close()


def _reason(error: Exception) -> str:
    """Why a connection failed, in a few words; asyncio's own text repeats the address."""
    if isinstance(error, OSError) and error.errno is not None and error.errno > 0:
        return os.strerror(error.errno).lower()
    return str(error) or type(error).__name__


async def serve_calls(
    reader: asyncio.StreamReader, writer: asyncio.StreamWriter, first: bytes, dispatch: Dispatch, guest: Guest
) -> None:
    """Answer the XML-RPC calls on a connection, of which the `first` bytes are read."""
    is_open = True
    while is_open:
        head = first + await reader.readuntil(b"\r\n\r\n")
        method, arguments = decode_call(await reader.readexactly(http_length(head)))
        number = guest.began()
        try:
            reply: Any = list(await dispatch(method, arguments))
        except TypeError:
            reply = [ERROR, f"{method} takes other arguments", 0]
        writer.write(encode_reply(reply))
        await writer.drain()
        guest.ended(number)
        is_open, first = stays_open(head), b""


class Ros1Server(Lifecycle):
    """A port: XML-RPC calls on it go to `dispatch`, other connections to `connected`.

    What is malformed is counted in `drops`, and its connection ends; so are connections that are too many.
    """

    title = "ROS 1 port"

    def __init__(
        self,
        host: str,
        port: int,
        dispatch: Dispatch,
        connected: Callable[[asyncio.StreamReader, asyncio.StreamWriter, dict[str, str]], Awaitable[None]] | None,
        drops: Drops,
    ) -> None:
        self._dispatch = dispatch
        self._connected = connected
        self._drops = drops
        self._host = host
        self._door = Door(LIMITS)
        self.port = port
        """Where it listens."""

    @property
    def uri(self) -> str:
        """The address of its XML-RPC API."""
        return f"http://{self._host}:{self.port}/"

    @property
    def guests(self) -> int:
        """How many connections are open."""
        return len(self._door)

    async def _open(self, stack: AsyncExitStack) -> None:
        self._tasks = await stack.enter_async_context(Background())
        self._is_listening = True
        try:
            server = await asyncio.start_server(self._accept, self._host, self.port, limit=WIRE_LIMITS.head)
        except (OSError, OverflowError) as error:
            raise PortUnavailable(self._host, self.port, _reason(error), option="--ros-master-uri") from None
        stack.push_async_callback(self._end, server)
        self.port = server.sockets[0].getsockname()[1]
        self._tasks.start(self._end_late(), "late connections")

    async def _end(self, server: asyncio.Server) -> None:
        """Accept no more. What asyncio has accepted reaches `_accept` two turns later; it fails if that is closed."""
        self._is_listening = False
        try:
            for listening in server.sockets:
                asyncio.get_running_loop().remove_reader(listening.fileno())
            for _ in range(3):
                await asyncio.sleep(0)
        finally:
            server.close()

    async def _end_late(self) -> None:
        while True:
            await asyncio.sleep(ROS1_NODE_LIMITS.check)
            self._door.end_late()

    def _accept(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        if not self._is_listening:  # it connected just before
            writer.transport.abort()
            return
        sender = str((writer.get_extra_info("peername") or ("",))[0])
        if len(self._door) >= LIMITS.connections:  # it is turned away, or another one for it
            self._drops.count("ros1-connection", sender)
        guest = self._door.enter(sender, writer.transport.abort)
        if guest is None:
            writer.transport.abort()
        else:
            serving = self._tasks.start(self._serve(reader, writer, sender, guest), "ROS 1 connection")
            serving.add_done_callback(lambda _: self._leave(guest, writer))  # also if it was cancelled before it began

    def _leave(self, guest: Guest, writer: asyncio.StreamWriter) -> None:
        self._door.leave(guest)
        writer.close()

    async def _serve(
        self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter, sender: str, guest: Guest
    ) -> None:
        try:
            first = await reader.readexactly(4)
            if first == b"POST":
                await serve_calls(reader, writer, first, self._dispatch, guest)
            elif self._connected is not None:
                body = await reader.readexactly(length_of(first, WIRE_LIMITS.header))
                guest.began()
                await self._connected(reader, writer, decode_header(body))
        except (WireError, asyncio.LimitOverrunError) as error:
            self._drops.count("ros1-malformed", sender)
            log.debug("a connection from %s ends: %s", sender, error)
        except (OSError, EOFError, Ros1Error):
            pass
        except Exception:
            log.exception("a connection of ROS 1 failed", extra=log_event("ros1-connection-failed"))


@dataclass(eq=False)
class Link:
    """A subscriber's connection, and which version of the topic's type it takes."""

    writer: asyncio.StreamWriter
    caller: str
    type: Ros1Type
    sent: int = 0

    def send(self, payload: bytes) -> bool:
        """Send a message, unless too much waits for this subscriber already."""
        transport = self.writer.transport
        if transport.is_closing() or transport.get_write_buffer_size() > ROS1_NODE_LIMITS.waiting:
            return False
        transport.write(frame(payload))
        self.sent += 1
        return True


class Ros1Publisher:
    """A topic that a node publishes, in all `versions` of its type at the same time.

    `default` is the version for those who take any. Messages in `kept`, by any key, are sent to each new subscriber.
    """

    def __init__(self, node: Ros1Node, topic: str, default: Ros1Type, versions: Iterable[Ros1Type]) -> None:
        self._node = node
        self.topic: Final = topic
        self._versions = {kind.md5: kind for kind in (default, *versions)}
        self._default = default
        self.type: Final = default.name
        self.links: set[Link] = set()
        self.kept: dict[str, Mapping[str, Any] | bytes] = {}
        self._linked = asyncio.Event()

    async def wait_for_subscriber(self, seconds: float) -> bool:
        """Return when there is a subscriber, or False after some seconds."""
        with suppress(TimeoutError):
            async with asyncio.timeout(seconds):
                await self._linked.wait()
        return self._linked.is_set()

    def publish(self, message: Mapping[str, Any] | bytes) -> None:
        """Publish a message: its fields, which are encoded in each subscriber's version, or the bytes of one."""
        encoded: dict[Ros1Type, bytes | None] = {}
        for link in self.links:
            if link.type not in encoded:
                encoded[link.type] = self._encoded(message, link.type)
            self._send(link, encoded[link.type])

    async def close(self) -> None:
        """Withdraw the topic. What was published before still reaches its subscribers."""
        await self._node._withdraw(self)
        for link in self.links:
            link.writer.close()

    def _send(self, link: Link, payload: bytes | None) -> None:
        if payload is not None and not link.send(payload):
            self._node.drops.count("ros1-slow", link.caller)

    def _encoded(self, message: Mapping[str, Any] | bytes, kind: Ros1Type) -> bytes | None:
        if isinstance(message, bytes):
            return message
        try:
            return kind.encode(message)
        except InvalidPayload as error:  # such as a cost over 32 bits, to a node of generation 3
            self._node.drops.count("ros1-version", self.topic)
            why = "this message has no form in the version of its type that some nodes have"
            log.info("%s: %s: %s", self.topic, why, error, extra=log_event("ros1-not-sent", topic=self.topic))
            return None

    async def serve(
        self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter, header: Mapping[str, str]
    ) -> None:
        """Serve a subscriber until it leaves."""
        md5, wanted = header.get("md5sum", ANY), header.get("type", ANY)
        kind = self._default if md5 == ANY else self._versions.get(md5)
        if kind is None or wanted not in (ANY, self.type):
            writer.write(encode_header({"error": f"{self.topic} is {self.type}, of another version: {md5}"}))
            return
        reply = {
            "callerid": self._node.name,
            "topic": self.topic,
            "type": self.type,
            "md5sum": kind.md5,
            "message_definition": kind.definition,
            "latching": "0",
        }
        writer.write(encode_header(reply))
        link = Link(writer, header.get("callerid", ""), kind)
        for message in self.kept.values():
            self._send(link, self._encoded(message, kind))
        self.links.add(link)
        self._linked.set()
        try:
            while await reader.read(4096):
                """A subscriber says nothing."""
        finally:
            self.links.discard(link)
            if not self.links:
                self._linked.clear()


class Ros1Subscription:
    """A topic that a node subscribes to, of any version: `received` is called with each message and the publisher's
    header, which says of which."""

    def __init__(self, node: Ros1Node, topic: str, type: str, received: Received) -> None:
        self._node = node
        self.topic: Final = topic
        self.type: Final = type
        self._received = received
        self._readers: dict[str, asyncio.Task[None]] = {}
        self._changed = asyncio.Event()
        self.connected: set[str] = set()
        """The addresses of the publishers that are connected."""

    async def wait_until_connected(self) -> None:
        """Return when all publishers that it knows are connected."""
        while not self._readers.keys() <= self.connected:
            self._changed.clear()
            await self._changed.wait()

    def update(self, publishers: Iterable[str]) -> None:
        """Connect to these publishers (addresses of nodes), and to no others. Our own nodes are left out."""
        wanted = {uri for uri in publishers if uri not in self._node.own}
        for uri in self._readers.keys() - wanted:
            self._readers.pop(uri).cancel()
        self._changed.set()
        for uri in wanted - self._readers.keys():
            name = f"{self.topic} of {uri}"
            self._readers[uri] = self._node.tasks.start(self._read_always(uri), name)

    async def close(self) -> None:
        self.update(())
        await self._node._withdraw(self)

    async def _read_always(self, uri: str) -> None:
        backoff = Backoff(RECONNECT)
        while True:
            began = time.monotonic()
            with suppress(OSError, EOFError, AiraError, asyncio.LimitOverrunError):
                await self._read(uri)
            self.connected.discard(uri)
            if time.monotonic() - began > ROS1_NODE_LIMITS.call:
                backoff.reset()
            await backoff.wait()

    async def _read(self, uri: str) -> None:
        found = await call_api(uri, "requestTopic", self._node.name, self.topic, [[TCPROS]])
        match found:
            case [str(), str(host), int(port)]:
                pass
            case _:
                raise WireError(f"{uri} offers no TCPROS")
        header = {"callerid": self._node.name, "topic": self.topic, "type": self.type, "md5sum": ANY}
        reader, writer, answer = await open_connection(host, port, header | {"message_definition": ""})
        try:
            self.connected.add(uri)
            self._changed.set()
            frames = Frames()
            while data := await reader.read(1 << 18):
                for payload in frames.feed(data):
                    self._received(payload, answer)
        except WireError as error:
            self._node.drops.count("ros1-malformed", answer.get("callerid", uri))
            log.debug("%s: %s", self.topic, error)
            raise
        finally:
            writer.close()


async def open_connection(
    host: str, port: int, header: Mapping[str, str]
) -> tuple[asyncio.StreamReader, asyncio.StreamWriter, dict[str, str]]:
    """Connect to a publisher or a service, and exchange headers. Raises `Ros1Error` if it refuses, `OSError`."""
    async with asyncio.timeout(ROS1_NODE_LIMITS.call):
        reader, writer = await asyncio.open_connection(host, port, limit=1 << 18)
        try:
            writer.write(encode_header({**header, "tcp_nodelay": "1"}))
            answer = decode_header(await reader.readexactly(length_of(await reader.readexactly(4), WIRE_LIMITS.header)))
            if error := answer.get("error"):
                raise Ros1Error(error[:300])
        except BaseException:
            writer.close()
            raise
    return reader, writer, answer


@dataclass(frozen=True)
class Ros1Service:
    """A service of a node, in all `versions` of its type (by MD5 sum)."""

    name: str
    default: Ros1ServiceType
    versions: Mapping[str, Ros1ServiceType]
    handler: Handler

    @property
    def type(self) -> str:
        return self.default.name

    async def serve(
        self, node: Ros1Node, reader: asyncio.StreamReader, writer: asyncio.StreamWriter, header: Mapping[str, str]
    ) -> None:
        """Answer one request, or all of a caller that stays connected."""
        md5 = header.get("md5sum", ANY)
        kind = self.default if md5 == ANY else self.versions.get(md5)
        if kind is None:
            writer.write(encode_header({"error": f"{self.name} is {self.type}, of another version: {md5}"}))
            return
        reply = {"callerid": node.name, "type": kind.name, "md5sum": kind.md5}
        parts = {"request_type": kind.request.name, "response_type": kind.reply.name}
        writer.write(encode_header(reply | parts))
        is_open = header.get("probe") != "1"
        while is_open:
            payload = await reader.readexactly(length_of(await reader.readexactly(4), WIRE_LIMITS.message))
            try:
                request = kind.request.decode(payload)
                answer = b"\x01" + frame(kind.reply.encode(await self.handler(request, header.get("callerid", ""))))
            except AiraError as error:
                answer = b"\x00" + frame(f"{error}; {error.hint}".removesuffix("; ").encode())
            writer.write(answer)
            await writer.drain()
            is_open = header.get("persistent") == "1"


_Registered: TypeAlias = Ros1Publisher | Ros1Subscription | Ros1Service


@dataclass
class Ros1Graph:
    """What the nodes of this process share: the master, and what is dropped. `watch` keeps them registered."""

    master: str
    host: str = "127.0.0.1"
    drops: Drops = field(default_factory=Drops)
    nodes: list[Ros1Node] = field(default_factory=list)
    outage: OutageLog = field(default_factory=lambda: OutageLog(log, "ros-master"))
    ended: asyncio.Event = field(default_factory=asyncio.Event)
    """Set when somebody shut one of the nodes down: by `rosnode kill`, or a new node of the same name."""
    ended_by: str = ""

    async def call(self, method: str, *arguments: Any) -> Any:
        """Call the master in the name of the first node. Raises `Ros1Error`."""
        return await call_api(self.master, method, self.nodes[0].name if self.nodes else "/aira", *arguments)

    async def topics(self, below: str = "") -> dict[str, str] | None:
        """The types of the topics that are published now, by name; None while the master is away."""
        try:
            return dict(await self.call("getPublishedTopics", below))
        except (Ros1Error, TypeError, ValueError):
            return None

    async def watch(self) -> None:
        """Register all nodes again whenever the master does not know them any more, until cancelled."""
        while True:
            await asyncio.sleep(ROS1_NODE_LIMITS.check)
            try:
                known = await self.knows_us()
                if not known or self.outage.is_down:
                    for node in self.nodes:
                        await node.register_all()
                self.outage.recovered("the ROS master answers, and knows our nodes")
            except Ros1Error as error:
                self.outage.failed(error, "connections that exist go on, new ones wait for the ROS master")

    async def knows_us(self) -> bool:
        """Whether the master knows our first node. Raises `Ros1Error` if it does not answer."""
        try:
            return bool(await self.call("lookupNode", self.nodes[0].name) == self.nodes[0].uri)
        except Ros1Error as error:
            if error.code == "ros1-unreachable":
                raise
            return False


class Ros1Node(Lifecycle):
    """A node: `async with Ros1Node(graph, "/name") as node`, then `advertise`, `subscribe`, `serve`.

    It listens on a port of its own. Entering raises `PortUnavailable`.
    """

    title = "ROS 1 node"

    def __init__(self, graph: Ros1Graph, name: str) -> None:
        self.graph: Final = graph
        self.name: Final = resolve(name, "/")
        self.drops: Final = graph.drops
        self._topics: dict[str, Ros1Publisher] = {}
        self._subscriptions: dict[str, Ros1Subscription] = {}
        self._services: dict[str, Ros1Service] = {}
        self._server = Ros1Server(graph.host, 0, self._dispatch, self._connected, graph.drops)

    @property
    def uri(self) -> str:
        """The address of its slave API."""
        return self._server.uri

    @property
    def own(self) -> set[str]:
        """The addresses of all nodes of this process."""
        return {node.uri for node in self.graph.nodes}

    async def _open(self, stack: AsyncExitStack) -> None:
        self.tasks = await stack.enter_async_context(Background())
        await stack.enter_async_context(self._server)
        self.graph.nodes.append(self)
        stack.callback(self.graph.nodes.remove, self)
        stack.push_async_callback(self._leave)

    async def advertise(self, topic: str, type: Ros1Type, versions: Iterable[Ros1Type] = ()) -> Ros1Publisher:
        """Publish a topic, also in other `versions` of its type. Without the master, it is registered later."""
        name = resolve(topic, self.name)
        publisher = Ros1Publisher(self, name, type, versions)
        self._topics[name] = publisher
        await self._register(publisher)
        return publisher

    async def subscribe(self, topic: str, type: str, received: Received) -> Ros1Subscription:
        """Subscribe to a topic, whatever version of its type its publishers have."""
        name = resolve(topic, self.name)
        self._subscriptions[name] = subscription = Ros1Subscription(self, name, type, received)
        await self._register(subscription)
        return subscription

    async def serve(
        self, name: str, type: Ros1ServiceType, handler: Handler, versions: Iterable[Ros1ServiceType] = ()
    ) -> None:
        """Offer a service, also in other `versions` of its type.

        `handler` gets the fields of a request and the caller's name; its `AiraError` fails the request.
        """
        known = {kind.md5: kind for kind in (type, *versions)}
        service = Ros1Service(resolve(name, self.name), type, known, handler)
        self._services[service.name] = service
        await self._register(service)

    async def call(self, name: str, kind: Ros1ServiceType, request: Mapping[str, Any]) -> dict[str, Any]:
        """Call a service of another node. Raises `Ros1Error` if it fails, or nobody offers it."""
        name = resolve(name, self.name)
        host, port = place_of(await call_api(self.graph.master, "lookupService", self.name, name))
        try:
            header = {"callerid": self.name, "service": name, "md5sum": kind.md5}
            reader, writer, _ = await open_connection(host, port, header)
            try:
                writer.write(frame(kind.request.encode(request)))
                succeeded = await reader.readexactly(1)
                reply = await reader.readexactly(length_of(await reader.readexactly(4), WIRE_LIMITS.message))
            finally:
                writer.close()
        except (OSError, EOFError) as error:
            raise Ros1Error(f"{name} does not answer: {_reason(error)}") from None
        if succeeded != b"\x01":
            raise Ros1Error(f"{name}: {reply[:300].decode(errors='replace')}")
        return kind.reply.decode(reply)

    async def register_all(self) -> None:
        """Register all topics and services with the master. Raises `Ros1Error`."""
        registered: list[_Registered] = [
            *self._topics.values(),
            *self._subscriptions.values(),
            *self._services.values(),
        ]
        for each in registered:
            await self._tell(each)

    async def _register(self, each: _Registered) -> None:
        try:
            await self._tell(each)
        except Ros1Error as error:
            self.graph.outage.failed(error, "new topics and services wait for the ROS master")

    async def _tell(self, each: _Registered) -> None:
        master, service_uri = self.graph.master, f"rosrpc://{self.graph.host}:{self._server.port}"
        match each:
            case Ros1Publisher():
                await call_api(master, "registerPublisher", self.name, each.topic, each.type, self.uri)
            case Ros1Subscription():
                each.update(await call_api(master, "registerSubscriber", self.name, each.topic, each.type, self.uri))
            case Ros1Service():
                await call_api(master, "registerService", self.name, each.name, service_uri, self.uri)

    async def _withdraw(self, each: Ros1Publisher | Ros1Subscription) -> None:
        registered: dict[str, Any] = self._topics if isinstance(each, Ros1Publisher) else self._subscriptions
        method = "unregisterPublisher" if isinstance(each, Ros1Publisher) else "unregisterSubscriber"
        if registered.get(each.topic) is each:
            del registered[each.topic]
            with suppress(Ros1Error):
                await call_api(self.graph.master, method, self.name, each.topic, self.uri)

    async def _leave(self) -> None:
        """Withdraw everything: other nodes need not find out by themselves."""
        uri = f"rosrpc://{self.graph.host}:{self._server.port}"
        calls = [("unregisterPublisher", topic, self.uri) for topic in self._topics]
        calls += [("unregisterSubscriber", topic, self.uri) for topic in self._subscriptions]
        calls += [("unregisterService", service, uri) for service in self._services]
        if self.graph.outage.is_down:
            return
        with suppress(Ros1Error):
            for method, *arguments in calls:
                await call_api(self.graph.master, method, self.name, *arguments)

    async def _connected(
        self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter, header: dict[str, str]
    ) -> None:
        """Somebody subscribes to a topic of ours, or calls a service."""
        if (service := self._services.get(header.get("service", ""))) is not None:
            await service.serve(self, reader, writer, header)
        elif (publisher := self._topics.get(header.get("topic", ""))) is not None:
            await publisher.serve(reader, writer, header)
        else:
            what = header.get("service") or header.get("topic") or "?"
            writer.write(encode_header({"error": f"{self.name} has no {what[:200]}"}))

    async def _dispatch(self, method: str, arguments: tuple[Any, ...]) -> tuple[int, str, Any]:
        """The slave API."""
        match method, arguments:
            case "getPid", _:
                return SUCCESS, "", os.getpid()
            case "getMasterUri", _:
                return SUCCESS, "", self.graph.master
            case "getPublications", _:
                return SUCCESS, "", [[each.topic, each.type] for each in self._topics.values()]
            case "getSubscriptions", _:
                return SUCCESS, "", [[each.topic, each.type] for each in self._subscriptions.values()]
            case "getBusStats", _:
                sent = [
                    [each.topic, 0, [[number, 0, link.sent, 1] for number, link in enumerate(each.links)]]
                    for each in self._topics.values()
                ]
                return SUCCESS, "", [sent, [[each.topic, []] for each in self._subscriptions.values()], []]
            case "getBusInfo", _:
                out = [(link.caller, "o", each.topic) for each in self._topics.values() for link in each.links]
                into = [(uri, "i", each.topic) for each in self._subscriptions.values() for uri in each.connected]
                links = enumerate((*out, *into))
                return SUCCESS, "", [[number, who, way, TCPROS, topic, 1] for number, (who, way, topic) in links]
            case "requestTopic", (_, str(topic), list(protocols)):
                if topic not in self._topics:
                    return FAILURE, f"{self.name} does not publish {topic}", 0
                if not any(one and one[0] == TCPROS for one in protocols if isinstance(one, list)):
                    return FAILURE, "only TCPROS", 0
                return SUCCESS, "", [TCPROS, self.graph.host, self._server.port]
            case "publisherUpdate", (_, str(topic), list(publishers)):
                if topic in self._subscriptions:
                    self._subscriptions[topic].update(uri for uri in publishers if isinstance(uri, str))
                return SUCCESS, "", 0
            case "paramUpdate", (_, _, _):
                return SUCCESS, "", 0
            case "shutdown", (_, *reason):
                self.graph.ended_by = f"{self.name} was shut down: {reason[0] if reason else ''}"
                self.graph.ended.set()
                return SUCCESS, "", 0
        return ERROR, f"no such method with these arguments: {method[:100]}", 0
