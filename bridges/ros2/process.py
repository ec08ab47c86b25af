"""The process of `aira bridge ros2`: its two sessions, its types, its metrics."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from mesh.errors import ConfigurationError, InputError
from mesh.network.endpoints import Endpoints
from mesh.ros import RosTypes
from mesh.telemetry.metrics import MetricFamily, by_label
from schemas.status import ALIVE

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping
    from pathlib import Path

    import zenoh

    from bridges.ros2.allowed import RosAllowed
    from bridges.ros2.bridge import RosBridge
    from mesh.settings import Settings

_LONGEST: Final = 1 << 20
"""Bytes of the longest file with a definition."""


class RosNothingAllowed(InputError, code="ros-nothing-allowed"):
    """No topic of the ROS 2 system may be carried, so the bridge has nothing to do."""

    def __init__(self) -> None:
        super().__init__(
            "no topic is allowed, and the bridge carries no others",
            hint="allow some: --publish /cmd_vel (to the robot), --subscribe '/camera/*' (from it)",
        )


class RosRouterShared(ConfigurationError, code="ros-router-shared"):
    """The ROS 2 system and the mesh are on one router, on which each would have the keys of the other."""

    def __init__(self, router: str) -> None:
        super().__init__(
            f"the ROS 2 system and the mesh are on the same router, {router}",
            hint="start another router for one of them, and name it: --ros2-connect tcp/HOST:PORT",
        )


def types_of(settings: Settings, allow: RosAllowed, folder: Path | None) -> RosTypes:
    """The types of the settings' distribution, and those in a folder (PACKAGE/msg/TYPE.msg).

    Raises `RosNothingAllowed`, `UnknownRosType`, `PackageMissing`.
    """
    if not allow.publish and not allow.subscribe:
        raise RosNothingAllowed
    types = RosTypes(settings.ros2_distribution)
    for path in sorted(folder.rglob("*.msg") if folder is not None else ()):
        with path.open(encoding="utf-8", errors="replace") as file:
            types.register(f"{path.parent.parent.name}/msg/{path.stem}", file.read(_LONGEST))
    return types


def ros_endpoints(settings: Settings) -> Endpoints:
    """Where the ROS 2 system is. Raises `RosRouterShared` if that is the mesh's router."""
    for endpoint in settings.ros2_connect:
        if endpoint in settings.connect:
            raise RosRouterShared(endpoint)
    return Endpoints(connect=settings.ros2_connect, timeout=settings.connect_timeout)


def check_apart(mesh: zenoh.Session, ros: zenoh.Session) -> None:
    """Raise `RosRouterShared` if both sessions are on one router, whatever it is called."""
    for router in {str(zid) for zid in mesh.info.routers_zid()} & {str(zid) for zid in ros.info.routers_zid()}:
        raise RosRouterShared(router)


def bridge_metrics(bridge: RosBridge) -> Iterable[MetricFamily]:
    """The metrics of a bridge."""
    counts = {"in": bridge.received, "out": bridge.published}
    help_text = "Messages from the ROS 2 system (in) and to it (out)"
    return (by_label("aira_ros2_messages_total", "counter", help_text, "direction", counts),)


def bridge_health(bridge: RosBridge, mesh: zenoh.Session, ros: zenoh.Session) -> Mapping[str, str]:
    """The health of each part: the two routers, and the ROS 2 system."""

    def linked(session: zenoh.Session) -> bool:
        return not session.is_closed() and bool(session.info.routers_zid())

    return {
        "channel": ALIVE if linked(mesh) else "waits for a router",
        "ros2": ALIVE if linked(ros) else "waits for the router of the ROS 2 system",
        "robot": ALIVE if bridge.is_present else "is absent",
    }
