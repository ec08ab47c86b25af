"""`aira bridge ros2`: a ROS 2 system as a device of an agent."""

from __future__ import annotations

import logging
from contextlib import AsyncExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from mesh.base.log_context import LogSource
from mesh.base.outage_log import OutageLog
from mesh.cli.options import with_settings
from mesh.cli.output import announce
from mesh.role.running import run_until_stopped
from mesh.settings import NetworkSettings, Ros2Settings, TelemetrySettings
from mesh.telemetry.logs import set_process_source
from schemas import parse_address

if TYPE_CHECKING:
    from collections.abc import Iterable

    from mesh.settings import Settings
    from mesh.telemetry.metrics import MetricFamily

log = logging.getLogger(__name__)


@click.command("ros2", short_help="connect a ROS 2 system (rmw_zenoh) as a device of an agent")
@click.option("--agent", required=True, metavar="ADDRESS", help="address of the agent that the robot belongs to")
@click.option("--name", default="robot", show_default=True, help="name of the device in the agent's keys")
@click.option("--domain", type=click.IntRange(0, 232), default=0, show_default=True, help="ROS_DOMAIN_ID of the robot")
@click.option("--namespace", default="", help="namespace of our node [none]")
@click.option(
    "--flavour",
    type=click.Choice(["rmw_zenoh", "ros2dds"]),
    default="rmw_zenoh",
    show_default=True,
    help="keys of rmw_zenoh, or of zenoh-bridge-ros2dds",
)
@click.option("--publish", multiple=True, metavar="PATTERN", help="topics to publish to the robot, as /cmd_vel")
@click.option("--subscribe", multiple=True, metavar="PATTERN", help="topics of the robot to carry, as /camera/*")
@click.option(
    "--types",
    "folder",
    type=click.Path(path_type=Path, file_okay=False, exists=True),
    help="folder with the definitions of own types: PACKAGE/msg/TYPE.msg",
)
@with_settings(NetworkSettings, Ros2Settings, TelemetrySettings)
def command(settings: Settings, **options: Any) -> None:
    """Connect a ROS 2 system to the mesh as a device of the agent at ADDRESS. Needs no ROS. Ctrl-C stops it.

    The system is reached at its Zenoh router (--ros2-connect), which must be another one than the mesh's. Nothing is
    carried but what --publish and --subscribe allow (both may be repeated). In a job, what its objective plays and its
    handlers publish goes to the robot, and what the robot says is recorded. In a site's roster, the bridge is a member
    with the role edge."""
    run_until_stopped(lambda: _serve(settings, **options), settings=settings, role="edge")


async def _serve(
    settings: Settings,
    *,
    agent: str,
    name: str,
    publish: tuple[str, ...],
    subscribe: tuple[str, ...],
    folder: Path | None,
    **robot: Any,
) -> None:
    from bridges.devices import LOG, answer_log_queries
    from bridges.ros2._bridge import RosBridge, check_apart, ros_endpoints, types_of
    from bridges.ros2._robot import RosAllowed
    from mesh.network import Endpoints
    from mesh.role.composition import open_network
    from mesh.role.running import wait_for_files
    from mesh.telemetry.serving import Telemetry
    from schemas.keys import DeviceTopicKey

    allow = RosAllowed(publish=publish, subscribe=subscribe)
    types, ros_at = types_of(settings, allow, folder), ros_endpoints(settings)
    log_key = str(DeviceTopicKey(agent, name, LOG))
    async with AsyncExitStack() as stack:
        telemetry = await stack.enter_async_context(Telemetry(settings.metrics_listen))
        await wait_for_files(settings)
        mesh = await open_network(
            stack, Endpoints.from_settings(settings), OutageLog(log, "router"), on_wait=telemetry.starting
        )
        ros = await open_network(stack, ros_at, OutageLog(log, "ros2-router"), on_wait=telemetry.starting)
        check_apart(mesh.session, ros.session)
        bridge = await stack.enter_async_context(
            RosBridge(mesh.session, ros.session, types, allow, agent=agent, name=name, **robot)
        )
        stack.enter_context(answer_log_queries(mesh.session, log_key, "edge"))
        set_process_source(LogSource("edge", parse_address(agent)))

        async def measure() -> Iterable[MetricFamily]:
            return (*bridge.families(), *mesh.families())

        stack.enter_context(telemetry.showing(measure=measure, health=bridge.parts))
        words = f"bridge of {agent}: {name} is the ROS 2 system at {', '.join(settings.ros2_connect)}"
        announce(log, "edge-started", words, device=name)
        await bridge.run()
