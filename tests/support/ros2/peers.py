"""The ROS 2 systems that the bridge is tested against: processes that print what they hear as lines of JSON."""

from __future__ import annotations

import asyncio
import json
import os
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Self

from tests.support.peers import require

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

HERE: Final = Path(__file__).parent
VECTORS: Final = HERE.parents[1] / "bridges" / "ros2" / "vectors"
SECONDS: Final = 30.0
"""Patience with a peer on a busy machine."""


class RosPeer:
    """A process of another ROS 2 system in a role: `async with hiroz("talker", endpoint) as peer`.

    `said` is its first line, which it prints when its endpoints are there.
    """

    def __init__(self, command: Sequence[str | Path], environment: Mapping[str, str] | None = None) -> None:
        self._command = [str(word) for word in command]
        self._environment = {**os.environ, **(environment or {})}

    async def __aenter__(self) -> Self:
        pipe = asyncio.subprocess.PIPE
        self._process = await asyncio.create_subprocess_exec(
            *self._command, stdin=pipe, stdout=pipe, env=self._environment, limit=1 << 20
        )
        try:
            async with asyncio.timeout(SECONDS):
                self.said = await self.next_line()
        except BaseException:
            await self.__aexit__()
            raise
        return self

    async def __aexit__(self, *exc_info: object) -> None:
        if self._process.returncode is None:
            self._process.kill()
        await self._process.communicate()

    @property
    def pid(self) -> int:
        """The id of its process."""
        return self._process.pid

    @property
    def is_alive(self) -> bool:
        """Whether it has not ended: a malformed attachment ends it."""
        return self._process.returncode is None

    async def line(self, key: str) -> Any:
        """What the next line that has `key` says of it; lines before that one are skipped."""
        async with asyncio.timeout(SECONDS):
            while True:
                line = await self.next_line()
                if key in line:
                    return line[key]

    async def next_line(self) -> dict[str, Any]:
        """The next line. Raises `EOFError` when the process has ended."""
        assert self._process.stdout is not None
        text = await self._process.stdout.readline()
        if not text:
            raise EOFError(f"{self._command[1:]} ended with {await self._process.wait()}")
        line: dict[str, Any] = json.loads(text)
        return line

    async def rest(self) -> list[dict[str, Any]]:
        """The remaining lines of a role that ends by itself."""
        lines = []
        async with asyncio.timeout(SECONDS):
            try:
                while True:
                    lines.append(await self.next_line())
            except EOFError:
                return lines


def hiroz(role: str, endpoint: str, **options: object) -> RosPeer:
    """The Rust peer of a `distribution` in a role, connected to a router."""
    distribution = options.pop("distribution", "jazzy")
    words = [f"{key}={value}" for key, value in {"connect": endpoint, **options}.items()]
    return RosPeer([require(f"ros2-{distribution}"), role, *words])


def sdk(role: str, endpoint: str, **options: object) -> RosPeer:
    """The Python peer zenoh-ros2-sdk in a role, connected to a router."""
    words = [f"{key}={value}" for key, value in options.items()]
    return RosPeer(
        [require("zenoh-ros2-sdk"), HERE / "sdk_peer.py", role, endpoint.rsplit(":", 1)[1], *words],
        # Where it would look for definitions that it is not given; it must find nothing, and fetch nothing.
        {"ZENOH_CONFIG_OVERRIDE": 'mode="client"', "GIT_PYTHON_REFRESH": "quiet", "ZENOH_ROS2_SDK_CACHE": os.devnull},
    )
