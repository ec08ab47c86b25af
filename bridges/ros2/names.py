"""Names of ROS 2 (topics, services, nodes, types) and the keys that rmw_zenoh makes of them."""

from __future__ import annotations

import re
from typing import Final

from bridges.ros2.errors import InvalidRosName

LONGEST_NAME: Final = 255
"""Characters of the longest name."""
LARGEST_DOMAIN: Final = 232
"""The largest ROS_DOMAIN_ID."""
ACTION: Final = "/_action/"
"""What stands between the name of an action and those of its services and topics."""
SEND_GOAL: Final = "_SendGoal"
"""How the type of the service ends that stands for an action."""

_NAME: Final = re.compile(r"(/[A-Za-z_][A-Za-z0-9_]*)+")
_NODE: Final = re.compile(r"[A-Za-z_][A-Za-z0-9_]*")
_TYPE: Final = re.compile(r"([a-z][a-z0-9_]*)/(msg|srv|action)/([A-Za-z][A-Za-z0-9_]*)")
_DDS_TYPE: Final = re.compile(r"([a-z][a-z0-9_]*)::(msg|srv|action)::dds_::([A-Za-z][A-Za-z0-9_]*)_")


def check_name(name: str) -> str:
    """The absolute name of a topic or service. Raises `InvalidRosName` if it is none."""
    if not _NAME.fullmatch(name):
        raise InvalidRosName(name, "it consists of parts such as /robot, of letters, digits and underscores")
    if len(name) > LONGEST_NAME:
        raise InvalidRosName(name, f"it has more than {LONGEST_NAME} characters")
    return name


def check_node(name: str) -> str:
    """The name of a node, without its namespace. Raises `InvalidRosName` if it is none."""
    if not _NODE.fullmatch(name) or len(name) > LONGEST_NAME:
        raise InvalidRosName(name, "a node's name consists of letters, digits and underscores")
    return name


def check_namespace(namespace: str) -> str:
    """A namespace: empty, or as in /robot. Raises `InvalidRosName`."""
    return check_name(namespace) if namespace.strip("/") else ""


def check_domain(domain: int) -> int:
    """A ROS_DOMAIN_ID. Raises `InvalidRosName` if it is out of range."""
    if not 0 <= domain <= LARGEST_DOMAIN:
        raise InvalidRosName(str(domain), f"a domain is from 0 to {LARGEST_DOMAIN}")
    return domain


def resolve(name: str, namespace: str, node: str) -> str:
    """The absolute name that a name has for a node: `chatter` is in its namespace, `~/state` below the node.

    Raises `InvalidRosName`.
    """
    if name.startswith("~/"):
        return check_name(f"{namespace}/{node}/{name[2:]}")
    return check_name(name if name.startswith("/") else f"{namespace}/{name}")


def full_type(name: str, kind: str = "msg") -> str:
    """The full name of a type: `std_msgs/msg/String` for `std_msgs/String`. Raises `InvalidRosName`."""
    parts = name.split("/")
    full = f"{parts[0]}/{kind}/{parts[1]}" if len(parts) == 2 else name
    if not _TYPE.fullmatch(full) or len(full) > LONGEST_NAME:
        raise InvalidRosName(name, "a type is as in std_msgs/msg/String")
    return full


def to_dds_type(name: str) -> str:
    """The name that rmw_zenoh gives a type: `std_msgs::msg::dds_::String_`. Raises `InvalidRosName`."""
    package, kind, short = full_type(name).split("/")
    return f"{package}::{kind}::dds_::{short}_"


def from_dds_type(text: str) -> str:
    """The full name of the type that rmw_zenoh calls so. Raises `InvalidRosName`."""
    found = _DDS_TYPE.fullmatch(text)
    if found is None or len(text) > LONGEST_NAME:
        raise InvalidRosName(text, "a type is as in std_msgs::msg::dds_::String_")
    return "/".join(found.groups())


def topic_key(domain: int, name: str, kind: str, type_hash: str) -> str:
    """The key of a topic or service of rmw_zenoh, by its absolute name, its type's full name and hash."""
    return f"{domain}/{name.strip('/')}/{to_dds_type(kind)}/{type_hash}"


def parse_topic_key(key: str) -> tuple[int, str, str, str]:
    """Domain, absolute name, type and hash of a topic's or service's key. Raises `InvalidRosName`."""
    domain, _, rest = key.partition("/")
    name, *type_and_hash = rest.rsplit("/", 2)
    if len(type_and_hash) != 2 or not domain.isdecimal() or not domain.isascii() or len(domain) > 3:
        raise InvalidRosName(key, "a key is as in 0/chatter/std_msgs::msg::dds_::String_/RIHS01_…")
    return check_domain(int(domain)), check_name(f"/{name}"), from_dds_type(type_and_hash[0]), type_and_hash[1]
