"""Real ROS 1 from Debian: its master, its tools, and nodes of rospy."""

from __future__ import annotations

import asyncio
import json
import subprocess
import tempfile
import xmlrpc.client
from contextlib import asynccontextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from tests.support.peers import require
from tests.support.ports import free_port
from tests.support.processes import Server
from tests.support.waiting import SECONDS

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Sequence

PYTHON: Final = "/usr/bin/python3"
NODES: Final = Path(__file__).parent / "nodes.py"
"""Nodes of rospy, by the name of a function."""


def environment(master: str, folder: Path, messages: Path | None = None) -> dict[str, str]:
    """What programs of ROS 1 find in their environment."""
    return {
        "PATH": "/usr/bin:/bin",
        "HOME": str(folder),
        "TMPDIR": tempfile.gettempdir(),
        "ROS_MASTER_URI": master,
        "ROS_IP": "127.0.0.1",
        "ROS_HOME": str(folder),
        "ROS_LOG_DIR": str(folder),
        "PYTHONUNBUFFERED": "1",
        "PYTHONPATH": str(messages / "python") if messages is not None else "",
    }


class RosMasterServer(Server):
    """The master of ROS 1."""

    name = "rosmaster"

    def __init__(self) -> None:
        super().__init__()
        self._program = require("rosmaster")
        self.port = free_port()

    @property
    def uri(self) -> str:
        """The address for ROS_MASTER_URI."""
        return f"http://127.0.0.1:{self.port}/"

    def command(self) -> Sequence[str | Path]:
        variables = [f"{name}={value}" for name, value in environment(self.uri, self.folder).items()]
        return ["env", *variables, self._program, "--core", "-p", str(self.port)]

    def is_ready(self) -> bool:
        try:
            with xmlrpc.client.ServerProxy(self.uri) as master:
                master.getPid("/test")
        except OSError:
            return False
        return True


class Ros1NodeProcess:
    """A running node of rospy: it takes JSON lines, and says JSON lines."""

    def __init__(self, process: asyncio.subprocess.Process) -> None:
        self.process = process

    def tell(self, value: object) -> None:
        """Send it a line."""
        assert self.process.stdin is not None
        self.process.stdin.write(json.dumps(value).encode() + b"\n")

    async def hear(self) -> Any:
        """The next line that it says."""
        assert self.process.stdout is not None
        async with asyncio.timeout(SECONDS):
            while line := await self.process.stdout.readline():
                if line.startswith((b"{", b"[", b'"')):
                    return json.loads(line)
        raise AssertionError("the node ended")


class Ros:
    """The programs of ROS 1 on one master."""

    def __init__(self, master: str, folder: Path, messages: Path | None = None) -> None:
        self.environment = environment(master, folder, messages)

    async def run(self, program: str, *arguments: str, seconds: float = SECONDS) -> str:
        """What a program prints until it ends."""
        process = await asyncio.create_subprocess_exec(
            require(program), *arguments, env=self.environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT
        )
        try:
            async with asyncio.timeout(seconds):
                output, _ = await process.communicate()
        finally:
            if process.returncode is None:
                process.kill()
                await process.wait()
        return output.decode()

    @asynccontextmanager
    async def recording(self, *arguments: str) -> AsyncIterator[asyncio.subprocess.Process]:
        """What `rosbag record` starts; waits for its end, which `-l`, `--duration` or a signal bring."""
        require("rosbag")
        process = await asyncio.create_subprocess_exec(
            "/usr/lib/rosbag/record", *arguments, env=self.environment, stdout=subprocess.DEVNULL
        )
        try:
            yield process
            async with asyncio.timeout(SECONDS):
                await process.wait()
        finally:
            if process.returncode is None:
                process.kill()
                await process.wait()

    @asynccontextmanager
    async def node(
        self, function: str, *arguments: str, messages: Path | None = None
    ) -> AsyncIterator[Ros1NodeProcess]:
        """A node of rospy, a function in `nodes.py`; killed at the end."""
        require("rospy")
        more = {} if messages is None else {"PYTHONPATH": str(messages / "python")}
        process = await asyncio.create_subprocess_exec(
            PYTHON, NODES, function, *arguments,
            env=self.environment | more, stdin=subprocess.PIPE, stdout=subprocess.PIPE,
        )  # fmt: skip
        try:
            yield Ros1NodeProcess(process)
        finally:
            if process.returncode is None:
                process.kill()
            await process.wait()
