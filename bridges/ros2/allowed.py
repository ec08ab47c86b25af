"""What of a ROS 2 system may be used: patterns of names, nothing by default."""

from __future__ import annotations

from dataclasses import dataclass
from fnmatch import fnmatchcase
from typing import Final, Literal, TypeAlias

from bridges.ros2.errors import RosNotAllowed
from bridges.ros2.names import ACTION

RosUse: TypeAlias = Literal["publish", "subscribe", "call", "serve"]


@dataclass(frozen=True, slots=True)
class RosAllowed:
    """The names that may be used, as patterns: `/odom`, `/camera/*`, `*`.

    `call` covers services, actions and parameters: an action by its own name, parameters by the name of their node.
    `serve` covers services and actions of ours.
    """

    publish: tuple[str, ...] = ()
    subscribe: tuple[str, ...] = ()
    call: tuple[str, ...] = ()
    serve: tuple[str, ...] = ()

    def allows(self, use: RosUse, name: str) -> bool:
        """Whether a topic or service (absolute name) may be used so."""
        patterns: tuple[str, ...] = getattr(self, use)
        return any(fnmatchcase(name.split(ACTION)[0], pattern) for pattern in patterns)

    def check(self, use: RosUse, name: str) -> None:
        """Raise `RosNotAllowed` unless a topic or service may be used so."""
        if not self.allows(use, name):
            raise RosNotAllowed(name, use)


EVERYTHING: Final = RosAllowed(publish=("*",), subscribe=("*",), call=("*",), serve=("*",))
