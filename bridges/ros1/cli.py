"""`aira bridge ros1`: a ROS 1 system as a device and a control surface of an agent."""

from __future__ import annotations

import ipaddress
import logging
import tempfile
from contextlib import AsyncExitStack
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import click

from mesh.base.log_context import LogSource, log_event
from mesh.cli.options import with_settings
from mesh.cli.output import announce
from mesh.errors import InputError, PortUnavailable
from mesh.role.running import fail, open_when_ready, run_until_stopped
from mesh.settings import (
    AccountSettings,
    ChainSettings,
    ExecutionSettings,
    NetworkSettings,
    Settings,
    TelemetrySettings,
)
from mesh.telemetry.logs import set_process_source

if TYPE_CHECKING:
    from bridges.ros1._topics import RosBridgeParts
    from bridges.ros1.node import Ros1Graph
    from mesh.telemetry.serving import Telemetry

log = logging.getLogger(__name__)

_OF_NODES: Final = {
    "/liability/executor": ("recording_topics", "keyfile", "keyfile_password_file"),
    "/liability/listener": ("factory_contract", "web3_http_provider", "web3_ws_provider", "ens_contract"),
    "/liability/infochan/ipfs_channel": ("lighthouse_contract",),
    "/liability/infochan/eth/signer": ("keyfile", "keyfile_password_file"),
    "/eth/erc20_token": ("factory_contract", "web3_http_provider", "web3_ws_provider", "ens_contract"),
    "/eth/eth_node": ("web3_http_provider", "web3_ws_provider", "ens_contract"),
}
PARAMETERS: Final = {f"{node}/{name}": name for node, names in _OF_NODES.items() for name in names} | {
    "/eth/erc20_token/token_contract": "erc20_token"
}
"""The parameters of the legacy stack's nodes, and our settings that they are."""
_IGNORED: Final = {
    "/liability/executor": ("ipfs_http_provider", "master_check_interval"),
    "/liability/infochan/ipfs_channel": ("ipfs_http_provider",),
    "/liability/infochan/ipfs_common_node": ("ipfs_file_providers", "ipfs_http_provider", "ipfs_swarm_connect_to"),
    "/liability/listener": ("ipfs_http_provider", "poll_interval"),
    "/liability/persistence": ("persistence_update_interval",),
    "/liability/player_service": ("ipfs_http_provider", "master_check_interval"),
}
WITHOUT_MEANING: Final = frozenset(f"{node}/{name}" for node, names in _IGNORED.items() for name in names)
"""The parameters of the legacy stack's nodes that nothing here needs; docs/reference/ros1.md says why."""
PRIVATE: Final = frozenset({"keyfile", "keyfile_password_file", "web3_http_provider", "web3_ws_provider"})
"""Settings that are read from the parameter server and never written to it: paths, and URLs of nodes."""
OURS: Final = "/liability/executor/aira_parameters"
"""The parameters that the bridge has set itself: names and values."""


@click.command("ros1", short_help="connect a ROS 1 system as a device and control surface of an agent")
@click.option("--agent", metavar="ADDRESS", help="address of a running agent [the keyfile's account, run here]")
@click.option("--name", default="ros1", show_default=True, help="name of the device in the agent's keys")
@click.option("--master", "serves_master", is_flag=True, help="serve a ROS master, rather than join one")
@click.option(
    "--ros-master-uri", envvar="ROS_MASTER_URI", default="http://127.0.0.1:11311", show_default=True,
    help="the ROS master to join, or where to serve one",
)  # fmt: skip
@click.option(
    "--ros-ip", default="127.0.0.1", show_default=True,
    help="address that our nodes listen on. ROS 1 has no access control: who reaches it can do what the agent allows",
)  # fmt: skip
@click.option("--files", "folders", multiple=True, type=click.Path(path_type=Path, file_okay=False, exists=True),
    help="folder that /ipfs/add_file and get_file may read and write [that for temporary files]",
)  # fmt: skip
@click.option("--original-timing", is_flag=True, help="publish a job's topics after one second, subscriber or not")
@click.option("--messages", type=click.Path(path_type=Path, file_okay=False), metavar="DIR",
    help="write the messages of the settings' generation as a catkin workspace to DIR, and end",
)  # fmt: skip
@click.option("--message-version", type=click.Choice(["3", "4", "5"]),
    help="version of messages for --messages, and for tools that take any [the settings' generation]",
)  # fmt: skip
@with_settings(
    NetworkSettings, AccountSettings, ChainSettings, ExecutionSettings, TelemetrySettings, "lighthouse_contract"
)
def command(settings: Settings, messages: Path | None, message_version: str | None, **options: Any) -> None:
    """Show an agent to a ROS 1 system with the names of the legacy stack: nodes, topics, services, parameters. Needs no
    ROS. Ctrl-C stops it.

    In a job, what its objective plays is published below /liability/eth_ADDRESS, and what nodes publish there is
    recorded. Messages of all generations are served at the same time. Nodes may sign and spend only if the agent's
    settings say open_services = true.
    """
    generation = message_version or str(settings.generation)
    if messages is not None:
        _write_messages(messages, generation)
        return
    run_until_stopped(lambda: _serve(settings, options | {"generation": generation}), settings=settings, role="edge")


def _write_messages(folder: Path, generation: str) -> None:
    from bridges.ros1._definitions import write_workspace

    try:
        packages = write_workspace(folder, generation)
    except InputError as error:
        fail(error)
    click.echo(f"{folder}/src has the packages {', '.join(packages)}: build it with catkin_make")
    if (folder / "python").exists():
        click.echo(f"{folder}/python has them as Python: export PYTHONPATH={folder}/python:$PYTHONPATH")
    click.echo(f"for rosmsg and rossrv: export ROS_PACKAGE_PATH={folder}/src:$ROS_PACKAGE_PATH")


async def _serve(settings: Settings, options: dict[str, Any]) -> None:
    from bridges.ros1._bridge import Ros1Bridge
    from bridges.ros1._topics import RosBridgeOptions
    from mesh.telemetry.serving import Telemetry
    from schemas import parse_address

    if options["agent"] is not None:
        options = options | {"agent": parse_address(options["agent"])}
    if not _is_loopback(options["ros_ip"]):
        facts = log_event("ros1-open", address=options["ros_ip"])
        log.warning(
            "ROS 1 has no access control: who reaches %s can do what the agent allows", options["ros_ip"], extra=facts
        )
    async with AsyncExitStack() as stack:
        telemetry = await stack.enter_async_context(Telemetry(settings.metrics_listen if options["agent"] else ""))
        graph = await _graph(options, stack, telemetry)
        settings = await settings_with_parameters(graph, settings)
        parts = await _parts(graph, settings, options, stack, telemetry)
        chosen = RosBridgeOptions(
            name=options["name"],
            recording_topics=frozenset(filter(None, map(str.strip, settings.recording_topics.split(",")))),
            as_original=options["original_timing"],
            folders=options["folders"] or (Path(tempfile.gettempdir()),),
            generation=options["generation"],
            is_alone=options["serves_master"],
            size_limit=settings.objective_size_limit,
        )
        bridge = await stack.enter_async_context(Ros1Bridge(parts, chosen))
        set_process_source(LogSource("edge", parse_address(parts.agent)))
        stack.enter_context(telemetry.showing(measure=bridge.measure, health=bridge.parts))
        words = f"bridge of {parts.agent}: the ROS master is {graph.master}"
        announce(log, "edge-started", words, device=options["name"])
        await bridge.run()


def _is_loopback(address: str) -> bool:
    try:
        return ipaddress.ip_address(address).is_loopback
    except ValueError:
        raise InputError(f"--ros-ip: {address!r} is no IP address", hint="as in 192.168.0.7") from None


async def _graph(options: dict[str, Any], stack: AsyncExitStack, telemetry: Telemetry) -> Ros1Graph:
    """The ROS graph, on our master or on another one, for which it waits, as nodes of ROS do."""
    from bridges.ros1._wire import Ros1Error, place_of
    from bridges.ros1.master import RosMaster
    from bridges.ros1.node import RECONNECT, Ros1Graph
    from mesh.base.flood import Drops
    from mesh.base.retry import Backoff

    drops, uri = Drops(), options["ros_master_uri"]
    try:
        port = place_of(uri)[1]
    except Ros1Error as error:
        raise InputError(f"--ros-master-uri: {error}", hint="as in http://127.0.0.1:11311") from None
    if options["serves_master"]:
        try:
            master = await stack.enter_async_context(RosMaster(options["ros_ip"], port, drops))
        except PortUnavailable as error:
            error.hint = "if a ROS master runs there, leave out --master; or choose another port by --ros-master-uri"
            raise
        return Ros1Graph(master.uri, options["ros_ip"], drops)
    graph, backoff = Ros1Graph(uri, options["ros_ip"], drops), Backoff(RECONNECT)
    while True:
        try:
            await graph.call("getUri")
        except Ros1Error as error:
            telemetry.starting(str(error))
            graph.outage.failed(error, "waiting for a ROS master: start roscore, or the bridge with --master")
            await backoff.wait()
        else:
            graph.outage.recovered("the ROS master answers")
            return graph


async def _parts(
    graph: Ros1Graph, settings: Settings, options: dict[str, Any], stack: AsyncExitStack, telemetry: Telemetry
) -> RosBridgeParts:
    """Those of the agent that is run here, or what is needed beside one that runs elsewhere."""
    from bridges.ros1._topics import RosBridgeParts
    from mesh.content import Exchange
    from mesh.role.composition import open_store, watching

    directory = settings.state_directory / "bridge" / "ros1"
    if options["agent"] is None:
        from mesh import Agent

        if not settings.keyfile:
            raise InputError(
                "there is no agent", hint="name the address of one (--agent), or a keyfile, whose agent is run here"
            )
        agent = await stack.enter_async_context(Agent(settings=settings))
        return RosBridgeParts(
            agent=agent.address,
            network=agent.network,
            channel=agent.channel,
            graph=graph,
            store=agent.parts.store,
            exchange=agent.parts.exchange,
            directory=directory,
        )
    network, channel = await open_when_ready(
        stack, settings, lambda: watching(settings), role="bridge", on_wait=telemetry.starting
    )
    store = await open_store(stack, settings, directory / "content", limit=settings.objective_size_limit)
    return RosBridgeParts(
        agent=options["agent"],
        network=network,
        channel=channel,
        graph=graph,
        store=store,
        exchange=await stack.enter_async_context(Exchange(network.session, store)),
        directory=directory,
    )


async def settings_with_parameters(graph: Ros1Graph, settings: Settings) -> Settings:
    """The settings, changed by the parameters of the legacy stack that are set; the others are set from the settings.

    They are read once. Those that an earlier bridge has set are not the user's, and are set again.
    """
    from bridges.ros1._wire import Ros1Error

    found, ours = dict[str, Any](), dict[str, str]()
    try:
        listed = await graph.call("getParamNames")
        names = {name for name in listed if isinstance(name, str)} if isinstance(listed, list) else set()
        values = {name: await graph.call("getParam", name) for name in names & {OURS, *PARAMETERS}}
        earlier = values.get(OURS)
        earlier = earlier if isinstance(earlier, list) else []
        for name, option in PARAMETERS.items():
            value, mine = values.get(name), str(getattr(settings, option))
            if isinstance(value, str) and value and value != mine and [name, value] not in earlier:
                found[option] = value
            elif option not in PRIVATE:
                ours[name] = mine
                await graph.call("setParam", name, mine)
        await graph.call("setParam", OURS, [list(each) for each in ours.items()])
        if ignored := ", ".join(sorted(names & WITHOUT_MEANING)):
            facts = log_event("option-retired", option=ignored)
            log.info("without meaning here, and not read: %s", ignored, extra=facts)
    except Ros1Error as error:
        graph.outage.failed(error, "the parameters of ROS are not read")
    if found:
        facts = log_event("ros1-parameters", names=", ".join(sorted(found)))
        log.info("the parameter server sets %s", ", ".join(sorted(found)), extra=facts)
    return replace(settings, **found)
