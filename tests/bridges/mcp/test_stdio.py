"""The door over stdin and stdout: a real process, its client, and what a broken client sends."""

from __future__ import annotations

import json
import signal
import subprocess
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
from mcp.shared.exceptions import MCPError
from mcp_types.version import LATEST_HANDSHAKE_VERSION, LATEST_MODERN_VERSION

from bridges.mcp._door import LONGEST_LINE
from tests.support.commands import AIRA, SOON
from tests.support.mcp.clients import stdio_client

if TYPE_CHECKING:
    from collections.abc import Iterator

HELLO = {
    "jsonrpc": "2.0",
    "id": 1,
    "method": "initialize",
    "params": {"protocolVersion": "2025-11-25", "capabilities": {}, "clientInfo": {"name": "test", "version": "1"}},
}
READY = {"jsonrpc": "2.0", "method": "notifications/initialized"}


@pytest.mark.parametrize("version", [LATEST_MODERN_VERSION, LATEST_HANDSHAKE_VERSION])
async def test_both_revisions_of_the_protocol_are_served(version: str, tmp_path: Path) -> None:
    async with stdio_client("--data-dir", str(tmp_path), version=version) as client:
        assert client.protocol_version == version
        assert {tool.name for tool in (await client.list_tools()).tools} >= {"find_robots", "order", "verify"}
        result = await client.call_tool("balance", {})
        assert result.is_error
        assert result.structured_content is not None
        assert result.structured_content["code"] == "signer-unavailable"
        with pytest.raises(MCPError):
            await client.call_tool("approve", {"id": "consent-0123456789abcdef"})


class Raw:
    """`aira mcp` with the lines that are written to it."""

    def __init__(self, folder: Path) -> None:
        self.process = subprocess.Popen(
            [*AIRA, "mcp", "--data-dir", str(folder)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
        )

    def send(self, line: bytes | dict[str, Any]) -> None:
        assert self.process.stdin is not None
        self.process.stdin.write(line if isinstance(line, bytes) else json.dumps(line).encode() + b"\n")
        self.process.stdin.flush()

    def read(self) -> dict[str, Any]:
        assert self.process.stdout is not None
        answer: dict[str, Any] = json.loads(self.process.stdout.readline())
        return answer

    def ask(self, line: dict[str, Any]) -> dict[str, Any]:
        """The answer to a request; what comes before it is left out."""
        self.send(line)
        while (answer := self.read()).get("id") != line["id"]:
            pass
        return answer


@pytest.fixture
def raw(tmp_path: Path) -> Iterator[Raw]:
    door = Raw(tmp_path)
    with door.process:
        yield door
        door.process.kill()


@pytest.mark.parametrize(
    "line",
    [
        b"no JSON\n",
        b"\xff\xfe\x00\n",
        b"[" * 100_000 + b"\n",
        b'{"jsonrpc":"2.0","id":7,"method":"tools/call","params":{"name":"order","arguments":"' + b"x" * 100 + b'"}}\n',
        b'{"jsonrpc":"2.0","id":7,"method":"tools/call","params":' + b" " * LONGEST_LINE + b"{}}\n",
    ],
    ids=["text", "bytes", "nested", "no-object", "too-long"],
)
def test_what_is_no_message_ends_nothing(raw: Raw, line: bytes) -> None:
    assert raw.ask(HELLO)["result"]["serverInfo"]["name"] == "aira-mesh"
    raw.send(READY)
    raw.send(line)
    answer = raw.ask({"jsonrpc": "2.0", "id": 8, "method": "tools/list"})
    assert "order" in {tool["name"] for tool in answer["result"]["tools"]}


def test_it_ends_when_its_client_does(raw: Raw) -> None:
    raw.ask(HELLO)
    assert raw.process.stdin is not None
    raw.process.stdin.close()
    assert raw.process.wait(SOON) == 0


def test_it_ends_by_a_signal(raw: Raw) -> None:
    raw.ask(HELLO)
    begin = time.monotonic()
    raw.process.send_signal(signal.SIGTERM)
    assert raw.process.wait(SOON) == 0
    assert time.monotonic() - begin < SOON


def test_stdout_has_only_messages(raw: Raw) -> None:
    raw.ask(HELLO)
    out, _ = raw.process.communicate(timeout=SOON)
    assert out == b""


def test_a_file_is_no_client(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("{}\n")
    command = [*AIRA, "mcp", "--data-dir", str(tmp_path)]
    for path in (tmp_path / "file", Path("/dev/null")):
        with path.open("rb") as file:
            done = subprocess.run(command, stdin=file, capture_output=True, check=False, timeout=SOON)
        assert done.returncode == 2
        assert b"[stdin-unusable]" in done.stderr
        assert b"--http" in done.stderr
