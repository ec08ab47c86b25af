"""Our node in a ROS 2 system, with its publishers and subscriptions; and what is around it: `RosGraph` follows the
tokens of all nodes and endpoints."""

from __future__ import annotations

import asyncio
import itertools
import threading
import time
from collections import Counter, defaultdict
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any, Final, NamedTuple, Self

import zenoh
from zenoh import ext

from bridges.ros2._wire import (
    ACTION,
    DEFAULT_QOS,
    SEND_GOAL,
    RosAttachment,
    RosEntity,
    RosQos,
    check_namespace,
    check_node,
    full_type,
    gid_of,
    parse_attachment,
    resolve,
    type_mismatch,
    unavailable,
)
from mesh.base.background import call_in_loop
from mesh.errors import ClosedError
from mesh.network import PumpLimits
from mesh.network.pump import Pump
from mesh.recording.ros import UnknownRosType
from schemas.errors import InputError, InvalidPayload
from schemas.payloads import Payload, PayloadType

if TYPE_CHECKING:
    from collections.abc import Callable

    from bridges.ros2._wire import RmwZenoh, Ros2Dds, RosEntityKind
    from mesh.base.flood import Drops
    from mesh.recording.ros import RosTypes


class RosGraphLimits(NamedTuple):
    """Nodes and endpoints that are remembered."""

    in_all: int = 16_384
    """Those of all sessions."""
    per_session: int = 4096
    """Those of one Zenoh session."""


GRAPH_LIMITS: Final = RosGraphLimits()


class RosGraph:
    """The nodes and endpoints of a ROS 2 system, ours included.

    Tokens that are malformed or too many are counted in `drops`.
    """

    def __init__(self, flavour: RmwZenoh | Ros2Dds, drops: Drops) -> None:
        self._flavour = flavour
        self._drops = drops
        self._lock = threading.Lock()
        self._entities: dict[str, RosEntity] = {}
        self._by_name: defaultdict[str, dict[str, RosEntity]] = defaultdict(dict)
        """The same by the name of their topic or service, empty for nodes."""
        self._counts: Counter[str] = Counter()
        self._waiting: set[asyncio.Future[None]] = set()
        self._notified = False
        self._subscriber: Any = None

    def start(self, session: zenoh.Session) -> None:
        """Follow the tokens on a session, beginning with those that are there."""
        self._loop = asyncio.get_running_loop()
        receive = zenoh.handlers.Callback(self._receive, indirect=False)
        self._subscriber = session.liveliness().declare_subscriber(self._flavour.selector, receive, history=True)

    def close(self) -> None:
        """Stop following. Call it while the session is open."""
        self._subscriber.undeclare()

    def entities(self) -> list[RosEntity]:
        with self._lock:
            return list(self._entities.values())

    def find(self, name: str, *kinds: RosEntityKind) -> list[RosEntity]:
        """The endpoints of a topic, service or action (absolute name), of some kinds or of all."""
        with self._lock:
            named = [*self._by_name.get(name, {}).values()]
            named += self._by_name.get(f"{name}{ACTION}send_goal", {}).values()
        return [entity for entity in named if not kinds or entity.kind in kinds]

    def nodes(self) -> list[str]:
        return sorted({entity.node_name for entity in self.entities() if entity.node})

    def topics(self) -> dict[str, list[str]]:
        """The topics, and the types that endpoints have for each. Those of actions are left out."""
        return self._types("publisher", "subscription")

    def services(self) -> dict[str, list[str]]:
        """The services that have a server, and their types. Those of actions are left out."""
        return self._types("server")

    def actions(self) -> dict[str, list[str]]:
        found: dict[str, set[str]] = defaultdict(set)
        for entity in self.entities():
            if entity.kind == "server" and entity.name.endswith(f"{ACTION}send_goal"):
                found[entity.name.split(ACTION)[0]].add(entity.type.removesuffix(SEND_GOAL))
        return {name: sorted(types) for name, types in sorted(found.items())}

    async def wait_for(self, condition: Callable[[], bool]) -> None:
        """Wait until a condition on this graph is true. It is checked when something changes."""
        while not condition():
            changed = asyncio.get_running_loop().create_future()
            self._waiting.add(changed)
            try:
                if condition():  # it came true before anything knew that somebody waits
                    return
                await changed
            finally:
                self._waiting.discard(changed)

    def _types(self, *kinds: RosEntityKind) -> dict[str, list[str]]:
        found: dict[str, set[str]] = defaultdict(set)
        for entity in self.entities():
            if entity.kind in kinds and ACTION not in entity.name:
                found[entity.name].add(entity.type)
        return {name: sorted(types) for name, types in sorted(found.items())}

    def _receive(self, sample: zenoh.Sample) -> None:
        """Take a token that came or went. Runs on Zenoh's thread: nothing waits anywhere, whatever arrives."""
        token = str(sample.key_expr)
        if sample.kind == zenoh.SampleKind.PUT:
            self._add(token)
        else:
            self._remove(token)
        if not self._notified:
            self._notified = True
            call_in_loop(self._loop, self._notify)

    def _add(self, token: str) -> None:
        try:
            entity = self._flavour.parse(token)
        except InputError:
            self._drops.count("bad-token")
            return
        with self._lock:
            if token in self._entities:
                return
            if len(self._entities) < GRAPH_LIMITS.in_all and self._counts[entity.session] < GRAPH_LIMITS.per_session:
                self._entities[token] = self._by_name[entity.name][token] = entity
                self._counts[entity.session] += 1
                return
        self._drops.count("token", entity.session)

    def _remove(self, token: str) -> None:
        with self._lock:
            gone = self._entities.pop(token, None)
            if gone is None:
                return
            self._counts[gone.session] -= 1
            if not self._counts[gone.session]:
                del self._counts[gone.session]
            del self._by_name[gone.name][token]
            if not self._by_name[gone.name]:
                del self._by_name[gone.name]

    def _notify(self) -> None:
        self._notified = False
        for changed in self._waiting:
            if not changed.done():
                changed.set_result(None)


CDR_HEADERS: Final = (b"\x00\x00", b"\x00\x01")
"""How a payload begins: plain CDR, big-endian or little-endian."""
LARGEST_PAYLOAD: Final = 64 * 1024 * 1024
"""Bytes of the largest message, request or reply that is taken."""

_ids: Final = itertools.count()
"""Numbers of nodes and endpoints, which are unique in a Zenoh session."""


@dataclass(slots=True)
class RosEndpoint:
    """A publisher, subscription, server or client of ours, which the ROS 2 system sees from `show` until `withdraw`.

    Show it last: what others send as soon as they see it must arrive.
    """

    name: str
    type: str
    key: str
    gid: bytes
    _declare: Callable[[], Any]
    """Declares its token; gives None where endpoints are not shown by tokens."""
    _token: Any = None

    def show(self) -> None:
        self._token = self._declare()

    def withdraw(self) -> None:
        if self._token is not None:
            self._token.undeclare()


class RosNode:
    """A node in a ROS 2 system, on a session."""

    def __init__(
        self,
        session: zenoh.Session,
        types: RosTypes,
        flavour: RmwZenoh | Ros2Dds,
        name: str,
        namespace: str,
        drops: Drops,
    ) -> None:
        self.session = session
        self.types = types
        self.flavour = flavour
        self.drops = drops
        self.graph = RosGraph(flavour, drops)
        self._name = check_node(name)
        self._namespace = check_namespace(namespace)
        self._id = next(_ids)

    def open(self) -> None:
        self._session_id = str(self.session.zid())
        self.graph.start(self.session)
        self._token = self._show(self.flavour.token(self._entity("node", self._id)))

    def close(self) -> None:
        if not self.session.is_closed():
            if self._token is not None:
                self._token.undeclare()
            self.graph.close()

    def resolve(self, name: str) -> str:
        """The absolute name of a topic or service. Raises `InputError`."""
        return resolve(name, self._namespace, self._name)

    def endpoint(
        self, kind: RosEntityKind, name: str, type_name: str, *, type_hash: str = "", qos: RosQos | None = None
    ) -> RosEndpoint:
        """An endpoint of this node, not shown yet. Raises `UnknownRosType` if neither type nor hash is known."""
        type_hash = type_hash or self.types.type_hash(type_name)
        facts = {"name": name, "type": type_name, "type_hash": type_hash, "qos": qos or DEFAULT_QOS}
        text = self.flavour.token(self._entity(kind, next(_ids), **facts))
        key = self.flavour.key(name, type_name, type_hash)
        return RosEndpoint(name, type_name, key, gid_of(text), partial(self._show, text))

    def others(self, name: str, *kinds: RosEntityKind) -> list[RosEntity]:
        """The endpoints of a name that other nodes have, or other nodes of this session."""
        return [one for one in self.graph.find(name, *kinds) if not self._is_mine(one)]

    async def wait(self, name: str, timeout: float, *kinds: RosEntityKind) -> list[RosEntity]:
        """Wait for endpoints of a name (or an action) that other nodes have; returns them.

        Raises `RosError` after `timeout` seconds.
        """
        try:
            async with asyncio.timeout(timeout):
                await self.graph.wait_for(lambda: bool(self.others(name, *kinds)))
        except TimeoutError:
            raise unavailable(name, timeout) from None
        return self.others(name, *kinds)

    def check_type(self, entities: list[RosEntity], type_name: str) -> None:
        """Raise `RosError` if none of the endpoints has the type as it is defined here."""
        try:
            type_hash = self.types.type_hash(type_name)
        except UnknownRosType:
            type_hash = ""
        for entity in entities:
            is_known = type_hash and entity.type_hash
            if not entity.type or (entity.type == type_name and (not is_known or type_hash == entity.type_hash)):
                return
        if entities:
            there = entities[0]
            here = (type_name, type_hash) if there.type == type_name else (type_name, "")
            raise type_mismatch(
                there.name, " ".join(filter(None, here)), " ".join(filter(None, (there.type, there.type_hash)))
            )

    def encoded(self, type_name: str, message: object) -> Payload:
        """A message as a payload of a type: a dict of its fields, an instance of its class, or a payload that fits.

        Raises `InvalidPayload`, `UnknownRosType`. What does not decode would stop a process of ROS 2, and so would a
        bool that is neither 0 nor 1: a payload is decoded, and encoded again.
        """
        match message:
            case Payload():
                self._check(type_name, message.type)
                return self.types.encode(self.types.decode(type_name, message.data))
            case None | dict():
                return self.types.message(type_name, **(message or {}))
        payload = self.types.encode(message)
        self._check(type_name, payload.type)
        return payload

    def payload_type(self, type_name: str) -> PayloadType:
        """The type of payloads, with the definition if it is known."""
        try:
            return self.types.payload_type(type_name)
        except UnknownRosType:
            return PayloadType("cdr", type_name)

    def payload(self, type_name: str, data: bytes) -> Payload:
        return Payload(data, self.payload_type(type_name))

    def _check(self, type_name: str, given: PayloadType) -> None:
        if given.encoding != "cdr" or full_type(given.schema_name) != full_type(type_name):
            raise InvalidPayload(type_name, f"it is a {given.schema_name} in {given.encoding}")

    def _entity(self, kind: RosEntityKind, identity: int, **facts: Any) -> RosEntity:
        domain = self.flavour.domain
        return RosEntity(kind, domain, self._session_id, self._id, identity, self._name, self._namespace, **facts)

    def _show(self, token: str) -> Any:
        return self.session.liveliness().declare_token(token) if token else None

    def _is_mine(self, entity: RosEntity) -> bool:
        if not self.flavour.has_nodes:
            return entity.session == self._session_id
        return (entity.session, entity.node_id) == (self._session_id, self._id)


@dataclass(frozen=True, slots=True)
class RosMessage:
    topic: str
    payload: Payload
    """Its bytes (CDR), and its type with the definition if that is known."""
    source_time_ns: int
    """When it was published, in nanoseconds since 1970 by the publisher's clock; 0 if that is not known."""
    sequence: int
    """Its number among the publisher's messages; 0 if that is not known."""
    gid: bytes
    """The publisher: 16 bytes; empty if it is not known."""


class RosPublisher:
    """A publisher of ours."""

    def __init__(self, node: RosNode, name: str, type_name: str, qos: RosQos) -> None:
        self.type: Final = full_type(type_name)
        self.qos: Final = qos
        self._node = node
        self._endpoint = node.endpoint("publisher", name, self.type, qos=qos)
        self._sequence = 0
        self._publisher = self._declare(node.session, self._endpoint.key)
        self._endpoint.show()

    def put(self, message: object) -> Payload:
        """Publish a message: a dict of fields, an instance of the type's class, or a payload. Returns the payload.

        A congested link drops it rather than block. Raises `InvalidPayload`.
        """
        payload = self._node.encoded(self.type, message)
        attachment = None
        if self._node.flavour.has_attachments:
            self._sequence += 1
            attachment = RosAttachment(self._sequence, time.time_ns(), self._endpoint.gid).encode()
        self._publisher.put(payload.data, attachment=attachment)
        return payload

    @property
    def is_heard(self) -> bool:
        """Whether a subscription was found. What is published before goes to nobody, unless it is transient local."""
        return bool(self.qos.is_transient_local or self._publisher.matching_status.matching)

    def close(self) -> None:
        """Withdraw it. Call it while the session is open."""
        self._publisher.undeclare()
        self._endpoint.withdraw()

    def _declare(self, session: zenoh.Session, key: str) -> Any:
        drop = zenoh.CongestionControl.DROP
        if not self.qos.is_transient_local:
            return session.declare_publisher(key, congestion_control=drop)
        # It says twice a second which message was its last, so that lost ones are noticed.
        misses = ext.MissDetectionConfig(heartbeat=None, sporadic_heartbeat=0.5)
        return ext.declare_advanced_publisher(
            session,
            key,
            congestion_control=drop,
            cache=ext.CacheConfig(max_samples=self.qos.kept),
            publisher_detection=True,
            sample_miss_detection=misses if self.qos.reliability == "reliable" else None,
        )


class RosSubscription:
    """The messages of a topic: `async with robot.subscribe("/odom") as messages:`, then `async for`.

    The oldest are dropped when too many wait. Malformed ones are dropped, too; `drops` counts both. Entering it waits
    for a publisher if no type was given. Raises `RosError`.
    """

    def __init__(self, node: RosNode, topic: str, type_name: str, qos: RosQos | None, timeout: float) -> None:
        self.topic: Final = topic
        self._node = node
        self._given = full_type(type_name) if type_name else ""
        self._qos = qos
        self._timeout = timeout
        self._pump: Pump[RosMessage] | None = None

    async def __aenter__(self) -> Self:
        type_name, type_hash, qos = await self._discover()
        self._type = self._node.payload_type(type_name)
        self._endpoint = self._node.endpoint("subscription", self.topic, type_name, type_hash=type_hash, qos=qos)
        self._pump = Pump(
            self._node.session,
            self._endpoint.key,
            self._convert,
            limits=PumpLimits(max(qos.kept, 1), 32 << 20, payload=LARGEST_PAYLOAD),
            drops=self._node.drops,
            declare=partial(_declare_late, self._node.session, qos) if qos.is_transient_local else None,
        )
        await self._pump.__aenter__()
        self._endpoint.show()
        return self

    async def __aexit__(self, *exc_info: object) -> None:
        pump, self._pump = self._pump, None
        if pump is None:
            return
        if not self._node.session.is_closed():
            self._endpoint.withdraw()
        await pump.__aexit__(*exc_info)

    def __aiter__(self) -> Self:
        return self

    async def __anext__(self) -> RosMessage:
        if self._pump is None:
            raise ClosedError("the subscription is not open", hint="use it inside `async with`")
        return await anext(self._pump)

    async def _discover(self) -> tuple[str, str, RosQos]:
        """The type, its hash if it is not known here, and the quality of service that fits the publishers."""
        publishers = self._node.others(self.topic, "publisher")
        if not publishers and not self._given:
            publishers = await self._node.wait(self.topic, self._timeout, "publisher")
        known = [publisher for publisher in publishers if publisher.type]
        if self._given:
            self._node.check_type(known, self._given)
            type_name, type_hash = self._given, ""
        elif not known:
            raise unavailable(self.topic, self._timeout)
        else:
            type_name, type_hash = known[0].type, known[0].type_hash
            self._node.check_type(known, type_name)
        return type_name, type_hash, self._qos or _fitting([publisher.qos for publisher in publishers])

    def _convert(self, sample: zenoh.Sample) -> RosMessage | None:
        data = sample.payload.to_bytes()
        if len(data) < 4 or data[:2] not in CDR_HEADERS:
            self._node.drops.count("bad-cdr", self.topic)
            return None
        if not self._node.flavour.has_attachments:
            return RosMessage(self.topic, Payload(data, self._type), 0, 0, b"")
        attached = None if sample.attachment is None else parse_attachment(sample.attachment.to_bytes())
        if attached is None:
            self._node.drops.count("bad-attachment", self.topic)
            return None
        return RosMessage(self.topic, Payload(data, self._type), attached.time_ns, attached.sequence, attached.gid)


def _fitting(offered: list[RosQos]) -> RosQos:
    """What a subscription asks for: transient local if a publisher offers that, reliable if all do."""
    depth = max([10, *(qos.kept for qos in offered)])
    reliable = all(qos.reliability == "reliable" for qos in offered)
    late = any(qos.is_transient_local for qos in offered)
    return RosQos(
        min(depth, 1000), "reliable" if reliable else "best-effort", "transient-local" if late else "volatile"
    )


def _declare_late(session: zenoh.Session, qos: RosQos, key: str, handler: Any) -> Any:
    """A subscriber that also gets what was published before."""
    recovery = ext.RecoveryConfig(periodic_queries=None, heartbeat=True)
    return ext.declare_advanced_subscriber(
        session,
        key,
        handler,
        history=ext.HistoryConfig(detect_late_publishers=True, max_samples=qos.kept),
        recovery=recovery if qos.reliability == "reliable" else None,
        subscriber_detection=True,
    )
