"""How ROS 2 looks on Zenoh: names, keys, quality of service, attachments and liveliness tokens; and its errors.

`RmwZenoh` and `Ros2Dds` are the two ways to write keys and tokens: of rmw_zenoh, and of zenoh-bridge-ros2dds, which
connects robots that speak DDS. There a topic's key is its name, tokens say what is there but not which node has it, and
messages have no attachment.

rmw_zenoh attaches 33 bytes to each message, request and reply. A process of ROS 2 aborts when they are malformed, so
they are made here only.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from struct import Struct
from typing import Final, Literal, NamedTuple, TypeAlias, cast, get_args

from mesh.errors import InputError, RemoteError


class RosError(RemoteError, code="ros-call-failed"):
    """The ROS 2 system did not do what was asked of a name (topic, service): its service gave no reply in time, or an
    unusable one; nothing has this name (`ros-unavailable`); or it is of another type, or of another definition of the
    type (`ros-type-mismatch`)."""


def unavailable(name: str, timeout: float) -> RosError:
    """The error for a name that nothing published, subscribed to or served within `timeout` seconds."""
    return RosError(
        f"{name}: nothing in the ROS 2 system has this name after {timeout:g} s",
        hint="compare the domain and the router with those of the robot (ROS_DOMAIN_ID, rmw_zenohd)",
        code="ros-unavailable",
    )


def type_mismatch(name: str, here: str, there: str) -> RosError:
    """The error for a name that has another type in the ROS 2 system."""
    return RosError(f"{name}: its type is {there} in the ROS 2 system, and {here} here", code="ros-type-mismatch")


class RosGoalFailed(RemoteError, code="ros-goal-failed"):
    """The goal of an action was rejected, aborted or cancelled by its server; `status` says which.

    `result` is the decoded result of a goal that was accepted.
    """

    def __init__(self, name: str, status: str, result: object = None) -> None:
        super().__init__(f"{name}: the goal was {status}")
        self.status = status
        self.result = result


class RosLimits(NamedTuple):
    """The bounds of names, tokens and queues."""

    name: int = 255
    """Characters of a name."""
    domain: int = 232
    """The largest ROS_DOMAIN_ID."""
    token: int = 2048
    """Characters of a token that is read."""
    depth: int = 10_000
    """Messages that a publisher or subscription of ours keeps."""


ROS_LIMITS: Final = RosLimits()
ACTION: Final = "/_action/"
"""What stands between the name of an action and those of its services and topics."""
SEND_GOAL: Final = "_SendGoal"
"""How the type of the service ends that stands for an action."""

_NAME: Final = re.compile(r"(/[A-Za-z_][A-Za-z0-9_]*)+")
_NODE: Final = re.compile(r"[A-Za-z_][A-Za-z0-9_]*")
_TYPE: Final = re.compile(r"([a-z][a-z0-9_]*)/(msg|srv|action)/([A-Za-z][A-Za-z0-9_]*)")
_DDS_TYPE: Final = re.compile(r"([a-z][a-z0-9_]*)::(msg|srv|action)::dds_::([A-Za-z][A-Za-z0-9_]*)_")


def _no_name(text: str, why: str) -> InputError:
    return InputError(f"{text[:160]!r} is not a name in ROS 2: {why}", code="invalid-ros-name")


def _no_token(text: str, why: str) -> InputError:
    return InputError(f"{text[:160]!r} is not a liveliness token of ROS 2: {why}", code="invalid-ros-token")


def check_name(name: str) -> str:
    """The absolute name of a topic or service. Raises `InputError` if it is none."""
    if not _NAME.fullmatch(name):
        raise _no_name(name, "it consists of parts such as /robot, of letters, digits and underscores")
    if len(name) > ROS_LIMITS.name:
        raise _no_name(name, f"it has more than {ROS_LIMITS.name} characters")
    return name


def check_node(name: str) -> str:
    """The name of a node, without its namespace. Raises `InputError` if it is none."""
    if not _NODE.fullmatch(name) or len(name) > ROS_LIMITS.name:
        raise _no_name(name, "a node's name consists of letters, digits and underscores")
    return name


def check_namespace(namespace: str) -> str:
    """A namespace: empty, or as in /robot. Raises `InputError`."""
    return check_name(namespace) if namespace.strip("/") else ""


def check_domain(domain: int) -> int:
    """A ROS_DOMAIN_ID. Raises `InputError` if it is out of range."""
    if not 0 <= domain <= ROS_LIMITS.domain:
        raise _no_name(str(domain), f"a domain is from 0 to {ROS_LIMITS.domain}")
    return domain


def resolve(name: str, namespace: str, node: str) -> str:
    """The absolute name that a name has for a node: `chatter` is in its namespace, `~/state` below the node.

    Raises `InputError`.
    """
    if name.startswith("~/"):
        return check_name(f"{namespace}/{node}/{name[2:]}")
    return check_name(name if name.startswith("/") else f"{namespace}/{name}")


def full_type(name: str, kind: str = "msg") -> str:
    """The full name of a type: `std_msgs/msg/String` for `std_msgs/String`. Raises `InputError`."""
    parts = name.split("/")
    full = f"{parts[0]}/{kind}/{parts[1]}" if len(parts) == 2 else name
    if not _TYPE.fullmatch(full) or len(full) > ROS_LIMITS.name:
        raise _no_name(name, "a type is as in std_msgs/msg/String")
    return full


def to_dds_type(name: str) -> str:
    """The name that rmw_zenoh gives a type: `std_msgs::msg::dds_::String_`. Raises `InputError`."""
    package, kind, short = full_type(name).split("/")
    return f"{package}::{kind}::dds_::{short}_"


def from_dds_type(text: str) -> str:
    """The full name of the type that rmw_zenoh calls so. Raises `InputError`."""
    found = _DDS_TYPE.fullmatch(text)
    if found is None or len(text) > ROS_LIMITS.name:
        raise _no_name(text, "a type is as in std_msgs::msg::dds_::String_")
    return "/".join(found.groups())


_QOS_FIELD: Final = re.compile(r"[0-9]{0,20}")


@dataclass(frozen=True, slots=True)
class RosQos:
    """How messages are delivered. `depth` is how many messages are kept for `keep-last`.

    `transient-local` publishers keep their last messages for subscriptions that come later.
    """

    depth: int = 10
    reliability: Literal["reliable", "best-effort"] = "reliable"
    durability: Literal["volatile", "transient-local"] = "volatile"
    history: Literal["keep-last", "keep-all"] = "keep-last"

    @property
    def is_transient_local(self) -> bool:
        return self.durability == "transient-local"

    @property
    def kept(self) -> int:
        return ROS_LIMITS.depth if self.history == "keep-all" else max(1, min(self.depth, ROS_LIMITS.depth))

    def encode(self) -> str:
        """The text in a token of rmw_zenoh, with all values that matter, since versions differ in what is default."""
        reliability = "1" if self.reliability == "reliable" else "2"
        durability = "1" if self.is_transient_local else "2"
        history = "1" if self.history == "keep-last" else "2"
        return f"{reliability}:{durability}:{history},{self.depth}:,:,:,,"


DEFAULT_QOS: Final = RosQos()
"""What a publisher, subscription or service has by default."""
SENSOR_DATA: Final = RosQos(depth=5, reliability="best-effort")
"""What sensors publish with."""
LATCHED: Final = RosQos(depth=1, durability="transient-local")
"""One message for late subscriptions: maps, descriptions, the states of goals."""


def parse_qos(text: str) -> RosQos:
    """The quality of service in a token of rmw_zenoh. Raises `InputError`."""
    parts = [part.split(",") for part in text.split(":")]
    if [len(part) for part in parts] != [1, 1, 2, 2, 2, 3]:
        raise _no_token(text, "its quality of service is not as in 1:2:1,10:,:,:,,")
    if not all(_QOS_FIELD.fullmatch(field) for part in parts for field in part):
        raise _no_token(text, "its quality of service has a field that is no number")
    if parts[5][0] == "2":
        raise _no_token(text, "it has a kind of liveliness that ROS 2 has given up")
    (reliability,), (durability,), (history, depth) = parts[:3]
    return RosQos(
        int(depth or 42),
        "best-effort" if reliability == "2" else "reliable",
        "transient-local" if durability == "1" else "volatile",
        "keep-all" if history == "2" else "keep-last",
    )


_LAYOUT: Final = Struct("<qqB16s")
GID_SIZE: Final = 16
ATTACHMENT_SIZE: Final = _LAYOUT.size


class RosAttachment(NamedTuple):
    """Who sent a message, when, and as which one."""

    sequence: int
    """Counted by the sender: of its messages, or of its requests; a reply has that of its request."""
    time_ns: int
    """When it was sent, in nanoseconds since 1970."""
    gid: bytes
    """The sender: 16 bytes. A reply has that of its request."""

    def encode(self) -> bytes:
        """The bytes. Raises `ValueError` for what has no form in them."""
        numbers = (self.sequence, self.time_ns)
        if len(self.gid) != GID_SIZE or not all(0 <= number < 1 << 63 for number in numbers):
            raise ValueError(f"{self} can't be attached to a message of ROS 2")
        return _LAYOUT.pack(self.sequence, self.time_ns, GID_SIZE, self.gid)


def parse_attachment(data: bytes) -> RosAttachment | None:
    """What the bytes say; None if they are malformed."""
    if len(data) != ATTACHMENT_SIZE:
        return None
    sequence, time_ns, size, gid = _LAYOUT.unpack(data)
    return RosAttachment(sequence, time_ns, gid) if size == GID_SIZE and sequence >= 0 else None


RosEntityKind: TypeAlias = Literal["node", "publisher", "subscription", "server", "client"]

PREFIX: Final = "@ros2_lv"

_CODES: Final = dict(zip(("NN", "MP", "MS", "SS", "SC"), get_args(RosEntityKind), strict=True))
_KINDS: Final = {kind: code for code, kind in _CODES.items()}
_NUMBER: Final = re.compile(r"[0-9]{1,19}")
_SESSION: Final = re.compile(r"[0-9a-f]{1,32}")
_HASH: Final = re.compile(r"[A-Za-z0-9_]{1,128}")
_NO_TYPE: Final = ("EMPTY_TOPIC_TYPE", "EMPTY_TOPIC_HASH")


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
        """The key of a topic or service, by its absolute name, its type's full name and hash."""
        return f"{self.domain}/{name.strip('/')}/{to_dds_type(kind)}/{type_hash}"

    def token(self, entity: RosEntity) -> str:
        """The token of an entity. Raises `InputError`."""
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
        """The entity of a token. Raises `InputError`."""
        if len(token) > ROS_LIMITS.token:
            raise _no_token(token, f"it has more than {ROS_LIMITS.token} characters")
        parts = token.split("/")
        # Newer systems add parts to those of an endpoint, such as the kinds of memory in which it takes messages.
        of_node, of_endpoint = 9, 13
        kind = cast("RosEntityKind | None", _CODES.get(parts[5])) if len(parts) >= of_node else None
        complete = len(parts) == of_node if kind == "node" else len(parts) >= of_endpoint
        if kind is None or parts[0] != PREFIX or not complete:
            raise _no_token(token, "it has not the parts of a node or endpoint")
        domain, session, node_id, identity = parts[1:5]
        are_numbers = all(_NUMBER.fullmatch(number) for number in (domain, node_id, identity))
        if not are_numbers or not _SESSION.fullmatch(session):
            raise _no_token(token, "domain, node and endpoint are numbers, and the session is hexadecimal")
        enclave, namespace = (check_namespace(_demangled(part)) for part in parts[6:8])
        identified = (check_domain(int(domain)), session, int(node_id), int(identity))
        entity = RosEntity(kind, *identified, check_node(parts[8]), namespace, enclave)
        return entity if kind == "node" else _endpoint(token, entity, *parts[of_node:of_endpoint])


def _endpoint(token: str, node: RosEntity, name: str, kind: str, type_hash: str, qos: str) -> RosEntity:
    if not _HASH.fullmatch(type_hash):
        raise _no_token(token, "the hash of its type has other characters than letters, digits and _")
    known = kind not in _NO_TYPE and type_hash not in _NO_TYPE
    return replace(
        node,
        name=check_name(_demangled(name)),
        type=from_dds_type(kind) if known else "",
        type_hash=type_hash if known else "",
        qos=parse_qos(qos),
    )


def _mangled(name: str) -> str:
    return name.replace("/", "%") or "%"


def _demangled(text: str) -> str:
    return text.replace("%", "/")


def gid_of(token: str) -> bytes:
    """The identity of an endpoint, 16 bytes, by its token."""
    import xxhash

    return xxhash.xxh3_128_intdigest(token.encode()).to_bytes(16, "little")


_DDS_KINDS: Final = {"publisher": "MP", "subscription": "MS", "server": "SS", "client": "SC"}
_DDS_CODES: Final = {code: kind for kind, code in _DDS_KINDS.items()} | {"AS": "server", "AC": "client"}
_DDS_TOKEN: Final = re.compile(
    r"@/([0-9a-f]{1,32})/@ros2_lv/(?:(M[PS])/([^/]+)/([^/]+)/([^/]+)|([SA][SC])/([^/]+)/([^/]+))"
)
_DDS_QOS: Final = re.compile(r"K?:([01]?):([0-3]?):(?:([01]),(-?[0-9]{1,10}))?(?::(.*))?")
_DDS_HASH: Final = re.compile(r"typehash=([A-Za-z0-9_]{1,128});")


class Ros2Dds:
    """Keys and tokens of zenoh-bridge-ros2dds. The bridge, not the key, chooses the domain."""

    has_attachments: Final = False
    has_nodes: Final = False

    def __init__(self, domain: int) -> None:
        self.domain = check_domain(domain)
        self.selector = "@/*/@ros2_lv/**"
        """What all tokens match."""

    def key(self, name: str, kind: str, type_hash: str) -> str:
        return name.strip("/")

    def token(self, entity: RosEntity) -> str:
        """The token of an entity; empty for a node, and for parts of actions other than the one that stands for all."""
        start = f"@/{entity.session}/@ros2_lv"
        name, kind = entity.name, entity.type
        if entity.kind == "node" or (ACTION in name and not name.endswith(f"{ACTION}send_goal")):
            return ""
        if ACTION in name:
            code = "AS" if entity.kind == "server" else "AC"
            return f"{start}/{code}/{_escaped(name.split(ACTION)[0])}/{_escaped(kind.removesuffix(SEND_GOAL))}"
        token = f"{start}/{_DDS_KINDS[entity.kind]}/{_escaped(check_name(name))}/{_escaped(full_type(kind))}"
        return token if entity.kind in ("server", "client") else f"{token}/{_dds_qos(entity.qos, entity.type_hash)}"

    def parse(self, token: str) -> RosEntity:
        """The entity of a token. Raises `InputError`."""
        found = _DDS_TOKEN.fullmatch(token)
        if found is None or len(token) > ROS_LIMITS.token:
            raise _no_token(token, "it has not the parts of a token of zenoh-bridge-ros2dds")
        session, topic_code, topic, topic_type, qos, code, service, service_type = found.groups()
        code = topic_code or code
        name = check_name("/" + (topic or service).replace("§", "/"))
        kind = full_type((topic_type or service_type).replace("§", "/"))
        if code in ("AS", "AC"):
            name, kind = f"{name}{ACTION}send_goal", f"{kind}{SEND_GOAL}"
        parsed, type_hash = _parse_dds_qos(qos) if qos else (DEFAULT_QOS, "")
        return RosEntity(
            cast("RosEntityKind", _DDS_CODES[code]),
            self.domain,
            session,
            0,
            0,
            "",
            name=name,
            type=kind,
            type_hash=type_hash,
            qos=parsed,
        )


def _escaped(name: str) -> str:
    return name.strip("/").replace("/", "§")


def _dds_qos(qos: RosQos, type_hash: str) -> str:
    reliability, durability = int(qos.reliability == "reliable"), int(qos.is_transient_local)
    history = f"{int(qos.history == 'keep-all')},{qos.depth}"
    described = f":typehash={type_hash};" if type_hash.startswith("RIHS") else ""
    return f":{reliability}:{durability}:{history}{described}"


def _parse_dds_qos(text: str) -> tuple[RosQos, str]:
    found = _DDS_QOS.fullmatch(text)
    if found is None:
        raise _no_token(text, "its quality of service is not as in :1:0:0,10")
    reliability, durability, history, depth, user_data = found.groups()
    described = _DDS_HASH.search(user_data or "")
    qos = RosQos(
        max(int(depth or 1), 1),
        "reliable" if reliability == "1" else "best-effort",
        "transient-local" if durability and durability != "0" else "volatile",
        "keep-all" if history == "1" else "keep-last",
    )
    return qos, described.group(1) if described else ""
