"""Our node in a ROS 2 system, and what is around it: `RosGraph` follows the tokens of all nodes and endpoints."""

from __future__ import annotations

import asyncio
import itertools
import threading
from collections import Counter, defaultdict
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any, Final

import zenoh

from bridges.ros2._wire import (
    ACTION,
    DEFAULT_QOS,
    SEND_GOAL,
    RosEntity,
    check_namespace,
    check_node,
    full_type,
    gid_of,
    resolve,
    type_mismatch,
    unavailable,
)
from mesh.base.background import call_in_loop
from mesh.recording.ros import UnknownRosType
from schemas.errors import InputError, InvalidPayload
from schemas.payloads import Payload, PayloadType

if TYPE_CHECKING:
    from collections.abc import Callable

    from bridges.ros2._wire import RmwZenoh, Ros2Dds, RosEntityKind, RosQos
    from mesh.base.flood import Drops
    from mesh.recording.ros import RosTypes


PER_SESSION: Final = 4096
"""Those of one Zenoh session."""


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
        """The actions that have a server, and their types."""
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
            # Nodes and endpoints that are remembered.
            if len(self._entities) < 16_384 and self._counts[entity.session] < PER_SESSION:
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
        """Take the token back, if there is one."""
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
