"""What the bridge is built from, and how it serves its graph."""

from __future__ import annotations

import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from bridges.ros1.node import Ros1Graph
    from mesh.content import Exchange, Store
    from mesh.network import Channel, Network

GONE_SECONDS: Final = 30.0
"""For which the node that started a job may be away: it may be restarted. Then the job fails."""


@dataclass(frozen=True, kw_only=True)
class RosBridgeParts:
    """The agent with the address `agent`, which the bridge shows, and the ROS graph that it shows it to.

    `channel` is that of the agent's market; files are those of `store` and `exchange`; recordings of the player of
    bags are made in `directory`.
    """

    agent: str
    network: Network
    channel: Channel
    graph: Ros1Graph
    store: Store
    exchange: Exchange
    directory: Path


@dataclass(frozen=True, kw_only=True)
class RosBridgeOptions:
    """How a bridge serves its graph.

    It is the device `name` of its agent. `recording_topics` are recorded besides those of jobs. With `as_original`
    topics are published after a second, whether anybody subscribes or not. `folders` are those that the services for
    files may read and write, up to `size_limit` bytes of a file. `generation` is the version of messages for those who
    take any. With `is_alone`, our master is the only one: it has /rosout. A job whose node has disappeared for
    `gone_seconds` fails.
    """

    name: str = "ros1"
    recording_topics: frozenset[str] = frozenset()
    as_original: bool = False
    folders: tuple[Path, ...] = (Path(tempfile.gettempdir()),)
    generation: str = "3"
    is_alone: bool = False
    size_limit: int = 256 << 20
    gone_seconds: float = GONE_SECONDS
