"""What the agent's boards say, in the ROS graph: their topics have the names that the boards give them.

So a node hears a board on `aira edge` as it heard one on rosserial, in a job and outside.
"""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING, Final

import zenoh

from bridges.devices import is_said_by_device
from bridges.ros1._payloads import RosPayloads, advertise
from mesh.base.background import Background
from mesh.base.lifecycle import Lifecycle
from mesh.base.log_context import log_event
from mesh.errors import AiraError, InvalidKey
from mesh.network import Pump
from schemas import String
from schemas.errors import InvalidPayload
from schemas.keys import DeviceTopicKey, LiabilityTopicKey, device_selector, parse_agent_key, topic_selector
from schemas.payloads import STRING

if TYPE_CHECKING:
    from contextlib import AsyncExitStack

    from bridges.ros1._parts import RosBridgeParts
    from bridges.ros1.node import Ros1Node, Ros1Publisher
    from schemas.payloads import PayloadType

log = logging.getLogger(__name__)

DEVICES_NODE: Final = "/aira_devices"
RESERVED: Final = ("/liability/", "/eth/", "/ipfs/", "/rosbagplayer/", "/rosout")
"""What names of topics begin with that only the bridge publishes."""
MOST_TOPICS: Final = 256
"""Topics of devices."""
SUBSCRIBER_SECONDS: Final = 1.0
"""For which the first message of a topic waits for a subscriber that is there already."""


class RosDevices(Lifecycle):
    """The topics of the agent's devices on the node `node`: `async with RosDevices(...)`."""

    title = "devices on ROS 1"

    def __init__(self, parts: RosBridgeParts, node: Ros1Node) -> None:
        self._session = parts.network.session
        self._agent = parts.agent
        self._node = node
        self._payloads = RosPayloads()
        self._topics: dict[str, tuple[Ros1Publisher, PayloadType]] = {}
        self._refused: set[str] = set()
        """Keys whose refusal is in the log already."""

    async def _open(self, stack: AsyncExitStack) -> None:
        tasks = await stack.enter_async_context(Background())
        for selector in (topic_selector(self._agent), device_selector(self._agent)):
            pump: Pump[tuple[str, bytes, PayloadType]] = Pump(
                self._session,
                selector,
                self._taken,
                payload_limit=16 << 20,  # bytes of the largest message to ROS
                drops=self._node.drops,
            )
            await stack.enter_async_context(pump)
            tasks.start(self._publish_all(pump), f"devices on {selector}")

    def _taken(self, sample: zenoh.Sample) -> tuple[str, bytes, PayloadType] | None:
        """What a board says; robots of ROS 2 have a graph of their own. Runs on the pump's thread."""
        if sample.kind != zenoh.SampleKind.PUT or not is_said_by_device(sample.attachment):
            return None
        kind = self._payloads.type_of(sample)
        return None if kind.encoding == "cdr" else (str(sample.key_expr), sample.payload.to_bytes(), kind)

    async def _publish_all(self, pump: Pump[tuple[str, bytes, PayloadType]]) -> None:
        async for key, payload, kind in pump:
            try:
                parsed = parse_agent_key(key)
                if isinstance(parsed, DeviceTopicKey | LiabilityTopicKey):
                    await self._publish(parsed.topic, payload, kind)
            except AiraError as error:
                self._refuse(key, error)

    async def _publish(self, topic: str, payload: bytes, kind: PayloadType) -> None:
        """Raises `InvalidKey`, `InvalidGraphName`, `InvalidPayload`, `PackageMissing`."""
        if kind.encoding == "json":  # whose values may have another type each time
            payload, kind = String(payload.decode(errors="replace")).encode(), STRING
        else:
            payload, kind = self._payloads.for_ros(payload, kind)
        if topic not in self._topics:
            if topic.startswith(RESERVED) or len(self._topics) >= MOST_TOPICS:
                raise InvalidKey(topic, "the bridge has it itself, or has too many")
            publisher = await advertise(self._node, topic, kind)
            self._topics[topic] = publisher, kind
            await publisher.wait_for_subscriber(SUBSCRIBER_SECONDS)
        publisher, known = self._topics[topic]
        if kind != known:
            raise InvalidPayload(topic, f"it was {known.schema_name} before, and is {kind.schema_name}")
        publisher.publish(payload)

    def _refuse(self, key: str, error: AiraError) -> None:
        self._node.drops.count("ros1-topic", key)
        if key not in self._refused and len(self._refused) < MOST_TOPICS:
            self._refused.add(key)
            log.warning("a device is not heard in ROS: %s", error, extra=log_event("ros1-not-sent", topic=key))
