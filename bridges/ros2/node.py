"""Our node in a ROS 2 system: its tokens, and what its publishers, subscriptions, clients and servers share."""

from __future__ import annotations

import asyncio
import itertools
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any, Final

from bridges.ros2.errors import RosTypeMismatch, RosUnavailable
from bridges.ros2.graph import RosGraph
from bridges.ros2.names import check_namespace, check_node, full_type, resolve
from bridges.ros2.qos import DEFAULT_QOS
from bridges.ros2.tokens import RosEntity, gid_of
from mesh.ros import UnknownRosType
from schemas.errors import InvalidPayload
from schemas.payloads import Payload, PayloadType

if TYPE_CHECKING:
    from collections.abc import Callable

    import zenoh

    from bridges.ros2.dds import Ros2Dds
    from bridges.ros2.qos import RosQos
    from bridges.ros2.tokens import RmwZenoh, RosEntityKind
    from mesh.flood import Drops
    from mesh.ros import RosTypes

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
        """Let others see it."""
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
        """Show the node, and look around."""
        self._session_id = str(self.session.zid())
        self.graph.start(self.session)
        self._token = self._show(self.flavour.token(self._entity("node", self._id)))

    def close(self) -> None:
        """Hide the node."""
        if not self.session.is_closed():
            if self._token is not None:
                self._token.undeclare()
            self.graph.close()

    def resolve(self, name: str) -> str:
        """The absolute name of a topic or service. Raises `InvalidRosName`."""
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

        Raises `RosUnavailable` after `timeout` seconds.
        """
        try:
            async with asyncio.timeout(timeout):
                await self.graph.wait_for(lambda: bool(self.others(name, *kinds)))
        except TimeoutError:
            raise RosUnavailable(name, timeout) from None
        return self.others(name, *kinds)

    def check_type(self, entities: list[RosEntity], type_name: str) -> None:
        """Raise `RosTypeMismatch` if none of the endpoints has the type as it is defined here."""
        try:
            type_hash = self.types.type_hash(type_name)
        except UnknownRosType:
            type_hash = ""
        for entity in entities:
            if not entity.type or (entity.type == type_name and _same(type_hash, entity.type_hash)):
                return
        if entities:
            there = entities[0]
            here = (type_name, type_hash) if there.type == type_name else (type_name, "")
            raise RosTypeMismatch(
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
        """Bytes of a type."""
        return Payload(data, self.payload_type(type_name))

    def _check(self, type_name: str, given: PayloadType) -> None:
        """Raise `InvalidPayload` unless a payload is of a type."""
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


def _same(here: str, there: str) -> bool:
    return not here or not there or here == there
