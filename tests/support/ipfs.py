"""IPFS nodes for tests, alone on loopback: no bootstrap, no discovery, nobody found by chance."""

from __future__ import annotations

import json
import subprocess
from typing import TYPE_CHECKING, Any

from tests.support.peers import require
from tests.support.ports import free_port
from tests.support.processes import START_SECONDS, Server, ServerFailed

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path


class JsIpfs(Server):
    """A js-ipfs daemon: the HTTP RPC at `api` (below it `/api/v0/…`), the swarm at `swarm_address`."""

    name = "js-ipfs"

    def __init__(self) -> None:
        self._script: Path = require("js-ipfs")
        super().__init__()
        self._ports = {name: free_port() for name in ("API", "Gateway", "RPC", "Swarm", "WebSocket")}
        self.api = f"http://127.0.0.1:{self._ports['API']}"

    @property
    def peer_id(self) -> str:
        """The node's identity in the swarm."""
        identity: str = self._read_config()["Identity"]["PeerID"]
        return identity

    @property
    def swarm_address(self) -> str:
        """The address under which other nodes connect to this one (`swarm/connect`)."""
        return f"/ip4/127.0.0.1/tcp/{self._ports['Swarm']}/p2p/{self.peer_id}"

    def command(self) -> Sequence[str | Path]:
        if not self._config_file.exists():
            self._make_repository()
        return self._jsipfs("daemon")

    def is_ready(self) -> bool:
        return "Daemon is ready" in self.log()

    @property
    def _config_file(self) -> Path:
        return self.folder / "repo" / "config"

    def _jsipfs(self, *arguments: str) -> list[str | Path]:
        return ["env", f"IPFS_PATH={self.folder / 'repo'}", "node", self._script, *arguments]

    def _read_config(self) -> dict[str, Any]:
        config: dict[str, Any] = json.loads(self._config_file.read_text())
        return config

    def _make_repository(self) -> None:
        made = subprocess.run(
            self._jsipfs("init", "--profile", "test"),
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
            timeout=START_SECONDS,
            check=False,
        )
        if made.returncode != 0:
            raise ServerFailed(self.name, "made no repository", made.stdout + made.stderr)
        config = self._read_config()
        config["Addresses"].update(
            API=f"/ip4/127.0.0.1/tcp/{self._ports['API']}",
            Gateway=f"/ip4/127.0.0.1/tcp/{self._ports['Gateway']}",
            RPC=f"/ip4/127.0.0.1/tcp/{self._ports['RPC']}",
            Swarm=[
                f"/ip4/127.0.0.1/tcp/{self._ports['Swarm']}",
                f"/ip4/127.0.0.1/tcp/{self._ports['WebSocket']}/ws",
            ],
            Delegates=[],
        )
        config["Bootstrap"] = []
        config["Discovery"] = {"MDNS": {"Enabled": False}, "webRTCStar": {"Enabled": False}}
        self._config_file.write_text(json.dumps(config))
