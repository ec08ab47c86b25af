"""Definitions of ROS messages, services and actions as types of the package rosbags, which knows messages only.

A service and an action are made of messages, as rosidl does it: `my_robot/srv/Turn_Request`, `…_Response`, and of an
action the goal, the result, the feedback and what its services and its topic carry. The service itself is a type, too:
its hash covers request, response and event.
"""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Any, Final, TypeAlias

if TYPE_CHECKING:
    from collections.abc import Callable

Fields: TypeAlias = list[tuple[str, Any]]
Definitions: TypeAlias = dict[str, tuple[list[Any], Fields]]

_SEPARATOR: Final = re.compile(r"^---[ \t]*$", re.MULTILINE)


def interface_types(name: str, definition: str) -> Definitions:
    """The types in the text of a `.msg`, `.srv` or `.action` file, by the number of its parts.

    `name` is as in `std_msgs/msg/Header`; what stands for `msg` does not matter. Raises `TypesysError`, `ValueError`.
    """
    from rosbags.typesys import get_types_from_msg

    package, _, short = name.split("/", 2)
    parts = _SEPARATOR.split(definition)
    if len(parts) == 1:
        types: Definitions = get_types_from_msg(definition, f"{package}/msg/{short}")
        return {kind: (constants, fields or _no_fields()) for kind, (constants, fields) in types.items()}
    read = [_part(package, short, part) for part in parts]
    match read:
        case [request, response]:
            return _service(f"{package}/srv/{short}", request, response)
        case [goal, result, feedback]:
            return _action(f"{package}/action/{short}", goal, result, feedback)
    raise ValueError(f"it has {len(parts)} parts")


def described(store: Any, name: str, version: int) -> str:
    """The text of a type's definition and of those that it contains, for the schema of a recording."""
    if "/msg/" not in name:  # rosbags writes definitions of messages only
        store, name = _rewritten(store, name, _message_name), _message_name(name)
    definition, _ = store.generate_msgdef(name, ros_version=version)
    return str(definition)


def type_hash(store: Any, name: str) -> str:
    """The hash of a type of ROS 2 (RIHS01), as rosidl computes it. Raises `KeyError` for an unknown type."""
    return str(_rewritten(store, name, lambda kind: kind).hash_rihs01(name))


def _part(package: str, short: str, text: str) -> tuple[list[Any], Fields]:
    from rosbags.typesys import get_types_from_msg

    name = f"{package}/msg/{short}_Part"
    constants, fields = get_types_from_msg(text.strip("\n") + "\n", name)[name]
    return list(constants), list(fields) or _no_fields()


def _no_fields() -> Fields:
    """A message without fields is one byte in CDR, and has one field in hashes."""
    return [("structure_needs_at_least_one_member", _base("uint8"))]


def _base(name: str) -> Any:
    from rosbags.interfaces import Nodetype

    return Nodetype.BASE, (name, 0)


def _named(name: str) -> Any:
    from rosbags.interfaces import Nodetype

    return Nodetype.NAME, name


def _service(name: str, request: tuple[list[Any], Fields], response: tuple[list[Any], Fields]) -> Definitions:
    from rosbags.interfaces import Nodetype

    asked, answered, event = f"{name}_Request", f"{name}_Response", f"{name}_Event"
    at_most_one = {kind: (Nodetype.SEQUENCE, (_named(kind), 1)) for kind in (asked, answered)}
    info = _named("service_msgs/msg/ServiceEventInfo")
    whole = [("request_message", asked), ("response_message", answered), ("event_message", event)]
    return {
        asked: request,
        answered: response,
        event: ([], [("info", info), ("request", at_most_one[asked]), ("response", at_most_one[answered])]),
        name: ([], [(field, _named(kind)) for field, kind in whole]),
    }


def _action(
    name: str, goal: tuple[list[Any], Fields], result: tuple[list[Any], Fields], feedback: tuple[list[Any], Fields]
) -> Definitions:
    goal_id = ("goal_id", _named("unique_identifier_msgs/msg/UUID"))
    sent: Fields = [goal_id, ("goal", _named(f"{name}_Goal"))]
    accepted: Fields = [("accepted", _base("bool")), ("stamp", _named("builtin_interfaces/msg/Time"))]
    ended: Fields = [("status", _base("int8")), ("result", _named(f"{name}_Result"))]
    return {
        f"{name}_Goal": goal,
        f"{name}_Result": result,
        f"{name}_Feedback": feedback,
        f"{name}_FeedbackMessage": ([], [goal_id, ("feedback", _named(f"{name}_Feedback"))]),
        **_service(f"{name}_SendGoal", ([], sent), ([], accepted)),
        **_service(f"{name}_GetResult", ([], [goal_id]), ([], ended)),
    }


def _rewritten(store: Any, name: str, rename: Callable[[str], str]) -> Any:
    """A store with a type and all that it contains, renamed, with char as the uint8 that it is in ROS 2."""
    from rosbags.typesys.store import Typestore

    rewritten, left = Typestore(), [name]
    while left:
        kind = left.pop()
        if rename(kind) not in rewritten.fielddefs:
            constants, fields = store.fielddefs[kind]
            inner: Fields = [(field, _rewritten_node(node, rename, left)) for field, node in fields]
            rewritten.fielddefs[rename(kind)] = (constants, inner)
    return rewritten


def _rewritten_node(node: Any, rename: Callable[[str], str], found: list[str]) -> Any:
    """A field's type, rewritten. Adds the names in it to `found`."""
    from rosbags.interfaces import Nodetype

    kind, inner = node
    if kind == Nodetype.NAME:
        found.append(inner)
        return kind, rename(inner)
    if kind == Nodetype.BASE:
        return kind, ("uint8" if inner[0] == "char" else inner[0], inner[1])
    return kind, (_rewritten_node(inner[0], rename, found), inner[1])


def _message_name(name: str) -> str:
    return name.replace("/srv/", "/msg/").replace("/action/", "/msg/")
