"""A robot as a process of its own that loses its power at a commit: what it had not synced is gone."""

from __future__ import annotations

import asyncio
import json
import signal
import sys
from contextlib import asynccontextmanager, suppress
from typing import TYPE_CHECKING, Any, Literal

from mesh.dev import JsonRpcServer
from tests.support.market import MODEL

if TYPE_CHECKING:
    from collections.abc import AsyncIterator
    from pathlib import Path

    from tests.support.market import Place

SECONDS = 60.0
ROBOT = """
import asyncio, json, os, signal, sys
from mesh.agent.agent import Agent
from mesh.chain import Account
from mesh.settings import Settings
from mesh.agent.ledger import Ledger

given = json.load(sys.stdin)
fsync, set_position = os.fsync, Ledger.set_position

def noted_fsync(descriptor):
    fsync(descriptor)
    status = os.fstat(descriptor)
    with open(given["synced"], "a") as log:
        log.write(f"{status.st_ino} {status.st_size}\\n")

async def last_set_position(ledger, liability, position, *more, **named):
    await set_position(ledger, liability, position, *more, **named)
    if position == given["last"]:
        os.kill(os.getpid(), signal.SIGKILL)

os.fsync, Ledger.set_position = noted_fsync, last_set_position
account = Account(bytes.fromhex(given["key"]))
robot = Agent(given["model"], settings=Settings(**given["settings"]), account=account)

@robot.on_demand
async def offer(demand):
    await robot.offer(demand)

@robot.on("/say")
async def say(job, message):
    job.publish("/said", message.data)

robot.run()
"""


class PoweredRobot:
    """A robot that says what it is asked to, and is killed when the position `last` of its job is in the ledger."""

    def __init__(self, process: asyncio.subprocess.Process, recordings: Path, synced: Path) -> None:
        self._process = process
        self._recordings = recordings
        self._synced = synced

    async def lose_power(self, *, keeps: Literal["nothing", "the last sync"] = "the last sync") -> None:
        """Wait for the end of the process, and cut every recording to the length that it had at the last sync, or to
        nothing."""
        async with asyncio.timeout(SECONDS):
            _, said = await self._process.communicate()
        assert self._process.returncode == -signal.SIGKILL, said.decode()
        lines = [line.split() for line in self._synced.read_text().splitlines()]
        lengths = {int(file): int(length) for file, length in lines if keeps != "nothing"}
        for path in self._recordings.rglob("*.mcap*"):
            status = path.stat()
            with path.open("rb+") as file:
                file.truncate(min(status.st_size, lengths.get(status.st_ino, 0)))


@asynccontextmanager
async def powered_robot(place: Place, key: bytes, *, last: int) -> AsyncIterator[PoweredRobot]:
    """The robot of the place in a process of its own; its key is `key`."""
    synced = place.folder / "synced"
    settings: dict[str, Any] = {
        "connect": [place.endpoint],
        "data_dir": str(place.folder / "robot"),
        "lighthouse_contract": place.market.deployment.lighthouse_name,
        "ens_contract": place.market.deployment.ens,
        "poll_interval": 0.05,
        "playback": "at-once",
    }
    async with JsonRpcServer(place.node.provider) as server:
        settings["web3_http_provider"] = server.url
        given = {"synced": str(synced), "last": last, "model": MODEL, "settings": settings, "key": key.hex()}
        process = await asyncio.create_subprocess_exec(
            sys.executable, "-c", ROBOT, stdin=asyncio.subprocess.PIPE, stderr=asyncio.subprocess.PIPE
        )
        assert process.stdin is not None
        process.stdin.write(json.dumps(given).encode())
        process.stdin.close()
        try:
            yield PoweredRobot(process, place.folder / "robot", synced)
        finally:
            with suppress(ProcessLookupError):
                process.kill()
            await process.wait()
