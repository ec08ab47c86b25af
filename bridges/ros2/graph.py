"""What is in a ROS 2 system: nodes, topics, services and actions, by the liveliness tokens of their endpoints."""

from __future__ import annotations

import asyncio
import threading
from collections import Counter, defaultdict
from typing import TYPE_CHECKING, Any, Final

import zenoh

from bridges.ros2.errors import InvalidRosToken
from bridges.ros2.names import ACTION, SEND_GOAL
from mesh.background import call_in_loop

if TYPE_CHECKING:
    from collections.abc import Callable

    from bridges.ros2.dds import Ros2Dds
    from bridges.ros2.tokens import RmwZenoh, RosEntity, RosEntityKind
    from mesh.flood import Drops

ENTITIES: Final = 16_384
"""Nodes and endpoints that are remembered."""
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
        """All nodes and endpoints."""
        with self._lock:
            return list(self._entities.values())

    def find(self, name: str, *kinds: RosEntityKind) -> list[RosEntity]:
        """The endpoints of a topic, service or action (absolute name), of some kinds or of all."""
        with self._lock:
            named = [*self._by_name.get(name, {}).values()]
            named += self._by_name.get(f"{name}{ACTION}send_goal", {}).values()
        return [entity for entity in named if not kinds or entity.kind in kinds]

    def nodes(self) -> list[str]:
        """The names of the nodes, with their namespaces."""
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
        except InvalidRosToken:
            self._drops.count("bad-token")
            return
        with self._lock:
            if token in self._entities:
                return
            if len(self._entities) < ENTITIES and self._counts[entity.session] < PER_SESSION:
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
