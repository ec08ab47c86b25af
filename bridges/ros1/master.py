"""A master of ROS 1: names of nodes, topics and services, and the parameter server. It keeps everything in memory.

It does as the master of ROS does: nodes hear of publishers and parameters that they asked about, and a node whose name
is registered again, from another address, is shut down.
"""

from __future__ import annotations

import asyncio
import logging
import os
from contextlib import suppress
from typing import TYPE_CHECKING, Any, Final

from bridges.ros1._wire import ERROR, FAILURE, SUCCESS, InvalidGraphName, Ros1Error, resolve
from bridges.ros1.node import Ros1Server, call_api
from mesh.base.background import Background
from mesh.base.flood import Drops
from mesh.base.lifecycle import Lifecycle

if TYPE_CHECKING:
    from collections.abc import Iterator
    from contextlib import AsyncExitStack

log = logging.getLogger(__name__)

MOST_NAMES: Final = 20_000
"""Registrations and parameters, each, that it keeps."""

Reply = tuple[int, str, Any]


class RosMaster(Lifecycle):
    """A master on `host` and `port` (0: any): `async with RosMaster(...) as master`, then `master.uri`.

    Entering raises `PortUnavailable`.
    """

    title = "ROS 1 master"

    def __init__(self, host: str, port: int, drops: Drops | None = None) -> None:
        self._server = Ros1Server(host, port, self._dispatch, None, Drops() if drops is None else drops)
        self._nodes: dict[str, str] = {}
        self._registered: dict[str, dict[str, dict[str, str]]] = {"publisher": {}, "subscriber": {}, "parameter": {}}
        """By kind, then name of the topic or parameter: the nodes with their addresses."""
        self._services: dict[str, tuple[str, str]] = {}
        self._types: dict[str, str] = {}
        self.parameters: dict[str, Any] = {}
        self._calls = asyncio.Semaphore(64)  # nodes that it notifies at the same time

    @property
    def uri(self) -> str:
        """The address for ROS_MASTER_URI."""
        return self._server.uri

    async def _open(self, stack: AsyncExitStack) -> None:
        self._tasks = await stack.enter_async_context(Background())
        await stack.enter_async_context(self._server)

    async def _dispatch(self, method: str, arguments: tuple[Any, ...]) -> Reply:
        caller = arguments[0] if arguments and isinstance(arguments[0], str) else ""
        try:
            return self._answer(method, caller, *arguments[1:])
        except InvalidGraphName as error:
            return ERROR, str(error), 0

    def _answer(self, method: str, caller: str, *arguments: Any) -> Reply:
        match method, arguments:
            case "registerPublisher" | "registerSubscriber", (str(topic), str(kind), str(api)):
                return self._register_topic(method, caller, resolve(topic, caller), kind, api)
            case "unregisterPublisher", (str(topic), str(api)):
                topic = resolve(topic, caller)
                left = self._unregister("publisher", topic, caller, api)
                self._notify_subscribers(topic)
                return SUCCESS, "", left
            case "unregisterSubscriber", (str(topic), str(api)):
                return SUCCESS, "", self._unregister("subscriber", resolve(topic, caller), caller, api)
            case "registerService", (str(name), str(service_api), str(api)):
                self._add_node(caller, api)
                if len(self._services) < MOST_NAMES:
                    self._services[resolve(name, caller)] = caller, service_api
                return SUCCESS, "", 1
            case "unregisterService", (str(name), str(service_api)):
                name = resolve(name, caller)
                is_known = self._services.get(name) == (caller, service_api)
                if is_known:
                    del self._services[name]
                    self._forget_idle(caller)
                return SUCCESS, "", int(is_known)
            case "lookupService", (str(name),):
                provider = self._services.get(resolve(name, caller))
                return (FAILURE, f"no provider of {name}", "") if provider is None else (SUCCESS, "", provider[1])
            case "lookupNode", (str(name),):
                found = self._nodes.get(resolve(name, caller))
                return (ERROR, f"unknown node {name}", "") if found is None else (SUCCESS, "", found)
            case "getPublishedTopics", (str(below),):
                topics = sorted(topic for topic in self._registered["publisher"] if topic.startswith(below))
                return SUCCESS, "", [[topic, self._types.get(topic, "*")] for topic in topics]
            case "getTopicTypes", ():
                return SUCCESS, "", [list(each) for each in sorted(self._types.items())]
            case "getSystemState", ():
                state = [
                    [[topic, list(nodes)] for topic, nodes in sorted(self._registered[kind].items())]
                    for kind in ("publisher", "subscriber")
                ]
                return SUCCESS, "", [*state, [[name, [node]] for name, (node, _) in sorted(self._services.items())]]
            case "getUri", ():
                return SUCCESS, "", self.uri
            case "getPid", ():
                return SUCCESS, "", os.getpid()
        return self._parameter(method, caller, *arguments)

    def _parameter(self, method: str, caller: str, *arguments: Any) -> Reply:
        match method, arguments:
            case "setParam", (str(name), value):
                self._set(resolve(name, caller), value)
                return SUCCESS, "", 0
            case "deleteParam", (str(name),):
                path = _path(resolve(name, caller))
                within = self._find(path[:-1])
                if not path or not isinstance(within, dict) or path[-1] not in within:
                    return ERROR, f"parameter [{name}] is not set", 0
                del within[path[-1]]
                self._notify_of(resolve(name, caller), {})
                return SUCCESS, "", 0
            case "getParam", (str(name),):
                value = self._find(_path(resolve(name, caller)) if name != "/" else [])
                return (ERROR, f"parameter [{name}] is not set", 0) if value is None else (SUCCESS, "", value)
            case "hasParam", (str(name),):
                return SUCCESS, "", self._find(_path(resolve(name, caller))) is not None
            case "searchParam", (str(name),):
                found = self._search(name, caller)
                return (ERROR, f"parameter [{name}] is not set", "") if found is None else (SUCCESS, "", found)
            case "getParamNames", ():
                return SUCCESS, "", sorted(_names(self.parameters, ""))
            case "subscribeParam", (str(api), str(name)):
                name = resolve(name, caller)
                self._add_node(caller, api)
                self._add("parameter", name, caller, api)
                value = self._find(_path(name))
                return SUCCESS, "", {} if value is None else value
            case "unsubscribeParam", (str(api), str(name)):
                return SUCCESS, "", self._unregister("parameter", resolve(name, caller), caller, api)
        return ERROR, f"no such method with these arguments: {method[:100]}", 0

    def _register_topic(self, method: str, caller: str, topic: str, kind: str, api: str) -> Reply:
        is_publisher = method == "registerPublisher"
        self._add_node(caller, api)
        self._add("publisher" if is_publisher else "subscriber", topic, caller, api)
        if kind != "*" and (is_publisher or topic not in self._types) and len(self._types) < MOST_NAMES:
            self._types[topic] = kind
        if is_publisher:
            self._notify_subscribers(topic)
        others = self._registered["subscriber" if is_publisher else "publisher"]
        return SUCCESS, "", list(others.get(topic, {}).values())

    def _add_node(self, name: str, api: str) -> None:
        resolve(name, "/")
        before = self._nodes.get(name)
        if before is not None and before != api:
            self._notify(before, "shutdown", f"[{name}] was registered again")
            self._remove_node(name)
        if len(self._nodes) < MOST_NAMES:
            self._nodes[name] = api

    def _remove_node(self, name: str) -> None:
        for topics in self._registered.values():
            for topic in [topic for topic, nodes in topics.items() if name in nodes]:
                del topics[topic][name]
                if not topics[topic]:
                    del topics[topic]
        self._services = {service: found for service, found in self._services.items() if found[0] != name}
        self._nodes.pop(name, None)

    def _add(self, kind: str, name: str, node: str, api: str) -> None:
        if len(self._registered[kind]) < MOST_NAMES:
            self._registered[kind].setdefault(name, {})[node] = api

    def _unregister(self, kind: str, name: str, node: str, api: str) -> int:
        nodes = self._registered[kind].get(name, {})
        if nodes.get(node) != api:
            return 0
        del nodes[node]
        if not nodes:
            del self._registered[kind][name]
        self._forget_idle(node)
        return 1

    def _forget_idle(self, node: str) -> None:
        """A node without topics, services and parameters is gone."""
        of_topics = any(node in nodes for topics in self._registered.values() for nodes in topics.values())
        if not of_topics and not any(owner == node for owner, _ in self._services.values()):
            self._nodes.pop(node, None)

    def _notify_subscribers(self, topic: str) -> None:
        publishers = list(self._registered["publisher"].get(topic, {}).values())
        for api in self._registered["subscriber"].get(topic, {}).values():
            self._notify(api, "publisherUpdate", topic, publishers)

    def _notify_of(self, name: str, value: Any) -> None:
        for watched, nodes in self._registered["parameter"].items():
            if name == watched or name.startswith(f"{watched}/") or watched.startswith(f"{name}/"):
                for api in nodes.values():
                    self._notify(api, "paramUpdate", name, value)

    def _notify(self, api: str, method: str, *arguments: Any) -> None:
        self._tasks.start(self._call(api, method, *arguments), f"{method} of {api}")

    async def _call(self, api: str, method: str, *arguments: Any) -> None:
        async with self._calls:
            with suppress(Ros1Error):  # a node that has died does not answer
                await call_api(api, method, "/master", *arguments)

    def _find(self, path: list[str]) -> Any:
        found: Any = self.parameters
        for name in path:
            if not isinstance(found, dict) or name not in found:
                return None
            found = found[name]
        return found

    def _set(self, name: str, value: Any) -> None:
        path = _path(name)
        if not path:
            self.parameters = value if isinstance(value, dict) else {}
            return
        within = self.parameters
        for part in path[:-1]:
            inner = within.get(part)
            if not isinstance(inner, dict):
                inner = within[part] = {}
            within = inner
        if path[-1] in within or len(within) < MOST_NAMES:
            within[path[-1]] = value
        self._notify_of(name, value)

    def _search(self, name: str, caller: str) -> str | None:
        """The parameter that a name means for a node: the nearest one from its namespace upwards."""
        if name.startswith("/"):
            return name if self._find(_path(name)) is not None else None
        first, parts = name.partition("/")[0], _path(caller)
        for depth in range(len(parts), -1, -1):
            if self._find([*parts[:depth], first]) is not None:
                return "/" + "/".join([*parts[:depth], name])
        return None


def _path(name: str) -> list[str]:
    return [part for part in name.split("/") if part]


def _names(values: Any, below: str) -> Iterator[str]:
    if isinstance(values, dict) and values:
        for name, value in values.items():
            yield from _names(value, f"{below}/{name}")
    elif below:
        yield below
