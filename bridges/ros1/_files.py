"""The legacy stack's services for files: `/ipfs/add_file`, `/ipfs/get_file`, and its player of bags, `/rosbagplayer/*`.

Files are those of the mesh's stores. A service reads and writes only below the folders that it is given: by default the
one for temporary files, where the legacy programs put theirs.
"""

from __future__ import annotations

import asyncio
import logging
import secrets
import shutil
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from bridges.ros1._definitions import md5_of, service_types
from bridges.ros1._jobs import LOOK_SECONDS, SUBSCRIBER_SECONDS
from bridges.ros1._payloads import advertise, type_in
from bridges.ros1._wire import resolve
from bridges.ros1.messages import plain
from mesh.base.background import Background
from mesh.base.lifecycle import Lifecycle
from mesh.base.log_context import log_event
from mesh.errors import AiraError, InputError
from mesh.recording import Recorder, RecordingAbout, open_objective, play

if TYPE_CHECKING:
    from collections.abc import Mapping
    from contextlib import AsyncExitStack

    from bridges.ros1._parts import RosBridgeOptions, RosBridgeParts
    from bridges.ros1.node import Ros1Node, Ros1Publisher, Ros1Subscription
    from mesh.recording import Objective

log = logging.getLogger(__name__)

FILES_NODE: Final = "/liability/infochan/ipfs_common_node"
PLAYER_NODE: Final = "/liability/player_service"
MOST_PLAYERS: Final = 16
"""Players of bags at the same time."""
FETCH_SECONDS: Final = 60.0
"""For a file, without a new block of it."""


@dataclass(eq=False)
class _Player:
    """A bag that is played below a namespace, while everything there is recorded."""

    objective: Objective
    namespace: str
    recorder: Recorder
    task: asyncio.Task[None] | None = None


class LegacyFiles(Lifecycle):
    """The services for files on two of the `nodes`: `async with LegacyFiles(...)`."""

    title = "files on ROS 1"

    def __init__(self, parts: RosBridgeParts, options: RosBridgeOptions, nodes: Mapping[str, Ros1Node]) -> None:
        self._parts = parts
        self._options = options
        self._files = nodes[FILES_NODE]
        self._player = nodes[PLAYER_NODE]
        self._folders = tuple(folder.resolve() for folder in options.folders)
        self._players: dict[str, _Player] = {}

    async def _open(self, stack: AsyncExitStack) -> None:
        self._tasks = await stack.enter_async_context(Background())
        stack.push_async_callback(self._stop_all)
        for node, name, type, handler in (
            (self._files, "/ipfs/add_file", "ipfs_common/IpfsUploadFile", self._add),
            (self._files, "/ipfs/get_file", "ipfs_common/IpfsDownloadFile", self._get),
            (self._player, "/rosbagplayer/new", "robonomics_liability/CreateRosbagPlayer", self._new),
            (self._player, "/rosbagplayer/start", "robonomics_liability/StartRosbagPlayer", self._start),
            (self._player, "/rosbagplayer/stop", "robonomics_liability/StopRosbagPlayer", self._stop),
        ):
            versions = service_types()[type]
            default = versions[md5_of(type, self._options.generation)]
            await node.serve(name, default, handler, versions.values())

    def _checked(self, text: str) -> Path:
        """A path below one of the folders. Raises `InputError`."""
        path = Path(text).resolve()
        if not any(path.is_relative_to(folder) for folder in self._folders):
            raise InputError(f"{text} is in no folder that the bridge may use: start it with --files FOLDER")
        return path

    async def _add(self, request: Mapping[str, Any], _caller: str) -> dict[str, Any]:
        try:
            cid = await asyncio.to_thread(self._parts.store.put_file, self._checked(plain(request)), pin="ros1")
        except (AiraError, OSError) as error:
            return {"success": False, "error_msg": str(error)}
        return {"success": True, "ipfs_address": cid}

    async def _get(self, request: Mapping[str, Any], _caller: str) -> dict[str, Any]:
        try:
            target = self._checked(plain(request["file"]))
            found = await self._fetch(plain(request["ipfs_address"]))
            await asyncio.to_thread(shutil.copyfile, found, target)
        except (AiraError, OSError) as error:
            return {"success": False, "error_msg": str(error)}
        return {"success": True}

    async def _fetch(self, cid: str) -> Path:
        return await self._parts.exchange.fetch(cid, size_limit=self._options.size_limit, timeout=FETCH_SECONDS)

    async def _new(self, request: Mapping[str, Any], _caller: str) -> dict[str, Any]:
        cid, namespace = plain(request["ipfs_address"]), request["namespace"]
        try:
            if len(self._players) >= MOST_PLAYERS:
                raise InputError(f"there are {MOST_PLAYERS} players already", hint="stop one: /rosbagplayer/stop")
            namespace = resolve(namespace, "/")
            objective = await asyncio.to_thread(open_objective, await self._fetch(cid))
            name = f"{cid}{namespace.replace('/', '_')}_{secrets.token_hex(4)}"
            self._parts.directory.mkdir(parents=True, exist_ok=True)
            about = RecordingAbout(objective=cid)
            recorder = await asyncio.to_thread(Recorder, self._parts.directory / f"{name}.mcap", about)
        except (AiraError, OSError) as error:
            return {"success": False, "error_msg": str(error)}
        self._players[name] = _Player(objective, namespace, recorder)
        return {"success": True, "player_id": name}

    async def _start(self, request: Mapping[str, Any], _caller: str) -> dict[str, Any]:
        name = request["player_id"]
        player = self._players.get(name)
        if player is None or player.task is not None:
            return {"success": False, "msg": f"no player {name} that could be started"}
        player.task = self._tasks.start(self._run(player), f"player {name}")
        return {"success": True, "msg": f"player {name} started"}

    async def _stop(self, request: Mapping[str, Any], _caller: str) -> dict[str, Any]:
        player = self._players.pop(request["player_id"], None)
        if player is None:
            return {"success": False}
        await self._end(player)
        cid = await asyncio.to_thread(self._parts.store.put_file, player.recorder.path, pin="ros1")
        await asyncio.to_thread(player.recorder.path.unlink)
        return {"success": True, "ipfs_address": cid}

    async def _run(self, player: _Player) -> None:
        subscriptions: dict[str, Ros1Subscription] = {}
        publishers: dict[str, Ros1Publisher] = {}
        await self._listen(player, subscriptions)
        recording = asyncio.create_task(self._record(player, subscriptions), name="record a player's topics")
        try:
            async for step in play(player.objective):
                message = step.message
                if message.topic not in publishers:
                    topic = f"{player.namespace}{message.topic}"
                    publishers[message.topic] = await advertise(self._player, topic, message.type)
                    await publishers[message.topic].wait_for_subscriber(SUBSCRIBER_SECONDS)
                publishers[message.topic].publish(message.payload)
                player.recorder.record(message.topic, message.payload, message.type, role="objective")
            await asyncio.Event().wait()  # it records until it is stopped
        except AiraError as error:
            log.warning("a player of bags failed: %s", error, extra=log_event("ros1-player-failed", code=error.code))
        finally:
            recording.cancel()
            for publisher in publishers.values():
                await publisher.close()
            for subscription in subscriptions.values():
                await subscription.close()

    async def _record(self, player: _Player, subscriptions: dict[str, Ros1Subscription]) -> None:
        """Record what other nodes publish below the namespace."""
        while True:
            await asyncio.sleep(LOOK_SECONDS)
            await self._listen(player, subscriptions)

    async def _listen(self, player: _Player, subscriptions: dict[str, Ros1Subscription]) -> None:
        """Subscribe to the topics below the namespace that the graph has now."""
        topics = await self._player.graph.topics(player.namespace) or {}
        for topic in topics.keys() - subscriptions.keys():
            received = partial(self._received, player, topic.removeprefix(player.namespace))
            subscriptions[topic] = await self._player.subscribe(topic, topics[topic], received)

    def _received(self, player: _Player, topic: str, payload: bytes, header: Mapping[str, str]) -> None:
        try:
            player.recorder.record(topic, payload, type_in(header), role="device")
        except AiraError as error:
            log.info("can't record %s: %s", topic, error, extra=log_event("message-not-recorded", key=topic))

    async def _end(self, player: _Player) -> None:
        if player.task is not None:
            player.task.cancel()
            await asyncio.wait([player.task])
        await asyncio.to_thread(player.recorder.close)

    async def _stop_all(self) -> None:
        for player in self._players.values():
            await self._end(player)
