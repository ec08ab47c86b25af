"""Liveliness tokens of rmw_zenoh: the nodes, publishers, subscriptions, servers and clients of a domain."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Final, Literal, TypeAlias, cast, get_args

from bridges.ros2.errors import InvalidRosName, InvalidRosToken
from bridges.ros2.names import (
    check_domain,
    check_name,
    check_namespace,
    check_node,
    from_dds_type,
    to_dds_type,
    topic_key,
)
from bridges.ros2.qos import DEFAULT_QOS, RosQos, parse_qos

RosEntityKind: TypeAlias = Literal["node", "publisher", "subscription", "server", "client"]

PREFIX: Final = "@ros2_lv"
LONGEST_TOKEN: Final = 2048
"""Characters of the longest token that is read."""

_CODES: Final = dict(zip(("NN", "MP", "MS", "SS", "SC"), get_args(RosEntityKind), strict=True))
_KINDS: Final = {kind: code for code, kind in _CODES.items()}
_NUMBER: Final = re.compile(r"[0-9]{1,19}")
_SESSION: Final = re.compile(r"[0-9a-f]{1,32}")
_HASH: Final = re.compile(r"[A-Za-z0-9_]{1,128}")
_NO_TYPE: Final = ("EMPTY_TOPIC_TYPE", "EMPTY_TOPIC_HASH")
_NODE_PARTS: Final = 9
_ENDPOINT_PARTS: Final = 13
"""Newer systems add parts to those of an endpoint, such as the kinds of memory in which it takes messages."""


@dataclass(frozen=True, slots=True)
class RosEntity:
    """A node or an endpoint in a ROS 2 system. Of a node the fields from `name` on are empty."""

    kind: RosEntityKind
    domain: int
    session: str
    """The Zenoh session: hexadecimal."""
    node_id: int
    id: int
    node: str
    """The node's name, without its namespace; empty if it is not known."""
    namespace: str = ""
    """Empty, or as in /robot."""
    enclave: str = ""
    name: str = ""
    """The absolute name of the topic or service."""
    type: str = ""
    """The type's full name; empty if it is not known."""
    type_hash: str = ""
    qos: RosQos = DEFAULT_QOS

    @property
    def node_name(self) -> str:
        """The node's name with its namespace."""
        return f"{self.namespace}/{self.node}"


class RmwZenoh:
    """Keys and tokens of rmw_zenoh in a domain."""

    has_attachments: Final = True
    has_nodes: Final = True

    def __init__(self, domain: int) -> None:
        self.domain = check_domain(domain)
        self.selector = f"{PREFIX}/{domain}/**"
        """What all tokens of the domain match."""

    def key(self, name: str, kind: str, type_hash: str) -> str:
        """The key of a topic or service."""
        return topic_key(self.domain, name, kind, type_hash)

    def token(self, entity: RosEntity) -> str:
        """The token of an entity. Raises `InvalidRosName`."""
        node = [
            _KINDS[entity.kind],
            _mangled(check_namespace(entity.enclave)),
            _mangled(check_namespace(entity.namespace)),
            check_node(entity.node),
        ]
        start = [PREFIX, str(entity.domain), entity.session, str(entity.node_id), str(entity.id)]
        if entity.kind == "node":
            return "/".join([*start, *node])
        topic = [_mangled(check_name(entity.name)), to_dds_type(entity.type), entity.type_hash, entity.qos.encode()]
        return "/".join([*start, *node, *topic])

    def parse(self, token: str) -> RosEntity:
        """The entity of a token. Raises `InvalidRosToken`."""
        try:
            return _parse(token)
        except InvalidRosName as error:
            raise InvalidRosToken(token, str(error)) from None


def _parse(token: str) -> RosEntity:
    if len(token) > LONGEST_TOKEN:
        raise InvalidRosToken(token, f"it has more than {LONGEST_TOKEN} characters")
    parts = token.split("/")
    kind = cast("RosEntityKind | None", _CODES.get(parts[5])) if len(parts) >= _NODE_PARTS else None
    complete = len(parts) == _NODE_PARTS if kind == "node" else len(parts) >= _ENDPOINT_PARTS
    if kind is None or parts[0] != PREFIX or not complete:
        raise InvalidRosToken(token, "it has not the parts of a node or endpoint")
    domain, session, node_id, identity = parts[1:5]
    if not all(_NUMBER.fullmatch(number) for number in (domain, node_id, identity)) or not _SESSION.fullmatch(session):
        raise InvalidRosToken(token, "domain, node and endpoint are numbers, and the session is hexadecimal")
    enclave, namespace = (check_namespace(_demangled(part)) for part in parts[6:8])
    entity = RosEntity(
        kind, check_domain(int(domain)), session, int(node_id), int(identity), check_node(parts[8]), namespace, enclave
    )
    return entity if kind == "node" else _endpoint(token, entity, *parts[_NODE_PARTS:_ENDPOINT_PARTS])


def _endpoint(token: str, node: RosEntity, name: str, kind: str, type_hash: str, qos: str) -> RosEntity:
    if not _HASH.fullmatch(type_hash):
        raise InvalidRosToken(token, "the hash of its type has other characters than letters, digits and _")
    known = kind not in _NO_TYPE and type_hash not in _NO_TYPE
    return RosEntity(
        node.kind,
        node.domain,
        node.session,
        node.node_id,
        node.id,
        node.node,
        node.namespace,
        node.enclave,
        check_name(_demangled(name)),
        from_dds_type(kind) if known else "",
        type_hash if known else "",
        parse_qos(qos),
    )


def _mangled(name: str) -> str:
    return name.replace("/", "%") or "%"


def _demangled(text: str) -> str:
    return text.replace("%", "/")


def gid_of(token: str) -> bytes:
    """The identity of an endpoint, 16 bytes, by its token."""
    import xxhash

    return xxhash.xxh3_128_intdigest(token.encode()).to_bytes(16, "little")
