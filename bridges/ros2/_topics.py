"""Publishers and subscriptions in a ROS 2 system."""

from __future__ import annotations

import time
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any, Final, Self

import zenoh
from zenoh import ext

from bridges.ros2._node import CDR_HEADERS, LARGEST_PAYLOAD
from bridges.ros2._wire import RosAttachment, RosQos, full_type, parse_attachment, unavailable
from mesh.errors import ClosedError
from mesh.network.pump import Pump
from schemas.payloads import Payload

if TYPE_CHECKING:
    from bridges.ros2._node import RosNode


@dataclass(frozen=True, slots=True)
class RosMessage:
    """A message of a ROS 2 topic."""

    topic: str
    payload: Payload
    """Its bytes (CDR), and its type with the definition if that is known."""
    source_time_ns: int
    """When it was published, in nanoseconds since 1970 by the publisher's clock; 0 if that is not known."""
    sequence: int
    """Its number among the publisher's messages; 0 if that is not known."""
    gid: bytes
    """The publisher: 16 bytes; empty if it is not known."""


class RosPublisher:
    """A publisher of ours."""

    def __init__(self, node: RosNode, name: str, type_name: str, qos: RosQos) -> None:
        self.type: Final = full_type(type_name)
        self.qos: Final = qos
        self._node = node
        self._endpoint = node.endpoint("publisher", name, self.type, qos=qos)
        self._sequence = 0
        self._publisher = self._declare(node.session, self._endpoint.key)
        self._endpoint.show()

    def put(self, message: object) -> Payload:
        """Publish a message: a dict of fields, an instance of the type's class, or a payload. Returns the payload.

        A congested link drops it rather than block. Raises `InvalidPayload`.
        """
        payload = self._node.encoded(self.type, message)
        attachment = None
        if self._node.flavour.has_attachments:
            self._sequence += 1
            attachment = RosAttachment(self._sequence, time.time_ns(), self._endpoint.gid).encode()
        self._publisher.put(payload.data, attachment=attachment)
        return payload

    @property
    def is_heard(self) -> bool:
        """Whether a subscription was found. What is published before goes to nobody, unless it is transient local."""
        return bool(self.qos.is_transient_local or self._publisher.matching_status.matching)

    def close(self) -> None:
        """Withdraw it. Call it while the session is open."""
        self._publisher.undeclare()
        self._endpoint.withdraw()

    def _declare(self, session: zenoh.Session, key: str) -> Any:
        drop = zenoh.CongestionControl.DROP
        if not self.qos.is_transient_local:
            return session.declare_publisher(key, congestion_control=drop)
        # It says twice a second which message was its last, so that lost ones are noticed.
        misses = ext.MissDetectionConfig(heartbeat=None, sporadic_heartbeat=0.5)
        return ext.declare_advanced_publisher(
            session,
            key,
            congestion_control=drop,
            cache=ext.CacheConfig(max_samples=self.qos.kept),
            publisher_detection=True,
            sample_miss_detection=misses if self.qos.reliability == "reliable" else None,
        )


class RosSubscription:
    """The messages of a topic: `async with robot.subscribe("/odom") as messages:`, then `async for`.

    The oldest are dropped when too many wait. Malformed ones are dropped, too; `drops` counts both. Entering it waits
    for a publisher if no type was given. Raises `RosError`.
    """

    def __init__(self, node: RosNode, topic: str, type_name: str, qos: RosQos | None, timeout: float) -> None:
        self.topic: Final = topic
        self._node = node
        self._given = full_type(type_name) if type_name else ""
        self._qos = qos
        self._timeout = timeout
        self._pump: Pump[RosMessage] | None = None

    async def __aenter__(self) -> Self:
        type_name, type_hash, qos = await self._discover()
        self._type = self._node.payload_type(type_name)
        self._endpoint = self._node.endpoint("subscription", self.topic, type_name, type_hash=type_hash, qos=qos)
        self._pump = Pump(
            self._node.session,
            self._endpoint.key,
            self._convert,
            capacity=max(qos.kept, 1),
            capacity_bytes=32 * 1024 * 1024,
            payload_limit=LARGEST_PAYLOAD,
            drops=self._node.drops,
            declare=partial(_declare_late, self._node.session, qos) if qos.is_transient_local else None,
        )
        await self._pump.__aenter__()
        self._endpoint.show()
        return self

    async def __aexit__(self, *exc_info: object) -> None:
        pump, self._pump = self._pump, None
        if pump is None:
            return
        if not self._node.session.is_closed():
            self._endpoint.withdraw()
        await pump.__aexit__(*exc_info)

    def __aiter__(self) -> Self:
        return self

    async def __anext__(self) -> RosMessage:
        if self._pump is None:
            raise ClosedError("the subscription is not open", hint="use it inside `async with`")
        return await anext(self._pump)

    async def _discover(self) -> tuple[str, str, RosQos]:
        """The type, its hash if it is not known here, and the quality of service that fits the publishers."""
        publishers = self._node.others(self.topic, "publisher")
        if not publishers and not self._given:
            publishers = await self._node.wait(self.topic, self._timeout, "publisher")
        known = [publisher for publisher in publishers if publisher.type]
        if self._given:
            self._node.check_type(known, self._given)
            type_name, type_hash = self._given, ""
        elif not known:
            raise unavailable(self.topic, self._timeout)
        else:
            type_name, type_hash = known[0].type, known[0].type_hash
            self._node.check_type(known, type_name)
        return type_name, type_hash, self._qos or _fitting([publisher.qos for publisher in publishers])

    def _convert(self, sample: zenoh.Sample) -> RosMessage | None:
        data = sample.payload.to_bytes()
        if len(data) < 4 or data[:2] not in CDR_HEADERS:
            self._node.drops.count("bad-cdr", self.topic)
            return None
        if not self._node.flavour.has_attachments:
            return RosMessage(self.topic, Payload(data, self._type), 0, 0, b"")
        attached = None if sample.attachment is None else parse_attachment(sample.attachment.to_bytes())
        if attached is None:
            self._node.drops.count("bad-attachment", self.topic)
            return None
        return RosMessage(self.topic, Payload(data, self._type), attached.time_ns, attached.sequence, attached.gid)


def _fitting(offered: list[RosQos]) -> RosQos:
    """What a subscription asks for: transient local if a publisher offers that, reliable if all do."""
    depth = max([10, *(qos.kept for qos in offered)])
    reliable = all(qos.reliability == "reliable" for qos in offered)
    late = any(qos.is_transient_local for qos in offered)
    return RosQos(
        min(depth, 1000), "reliable" if reliable else "best-effort", "transient-local" if late else "volatile"
    )


def _declare_late(session: zenoh.Session, qos: RosQos, key: str, handler: Any) -> Any:
    """A subscriber that also gets what was published before."""
    recovery = ext.RecoveryConfig(periodic_queries=None, heartbeat=True)
    return ext.declare_advanced_subscriber(
        session,
        key,
        handler,
        history=ext.HistoryConfig(detect_late_publishers=True, max_samples=qos.kept),
        recovery=recovery if qos.reliability == "reliable" else None,
        subscriber_detection=True,
    )
