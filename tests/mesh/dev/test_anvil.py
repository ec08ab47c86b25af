"""Starting, watching and stopping anvil, and keeping its chain."""

from __future__ import annotations

import asyncio
import errno
import os
import signal
import stat
import time
from typing import TYPE_CHECKING

import pytest

from mesh.chain import XRT, Account, Chain, Node, TransactionSender
from mesh.dev import EmbeddedChain
from mesh.dev.anvil import (
    ANVIL_PACE,
    find_anvil,
    serve_anvil,
)
from mesh.dev.development import ALLOWANCE, serve_chain
from mesh.errors import ConfigurationError, PortUnavailable, RemoteError
from mesh.settings import Settings
from tests.support.peers import require
from tests.support.ports import answers, free_port
from tests.support.processes import is_alive
from tests.support.raising import raises_with

if TYPE_CHECKING:
    from pathlib import Path

NEW_ACCOUNT = "0x00000000000000000000000000000000000000AA"


@pytest.fixture
def program() -> Path:
    """The real anvil."""
    return require("anvil")


async def test_anvil_runs_for_the_body_and_stops_after_it(program: Path) -> None:
    async with serve_anvil(program, host="127.0.0.1", port=0, block_time=None, state=None) as node:
        pid, port = node.pid, int(node.url.rpartition(":")[2])
        for url in (node.url, node.url.replace("http", "ws", 1)):
            async with Node(url) as client:
                assert await client.block_number() == 0
        async with EmbeddedChain() as embedded:
            assert node.funded_keys == embedded.funded_keys, "the accounts are the same whatever runs the chain"
        asked = time.monotonic()
    assert time.monotonic() - asked < ANVIL_PACE.stopping, "it was asked to end, not killed"
    assert not is_alive(pid)
    assert not answers(port)


async def test_empty_blocks_are_mined_with_a_block_time(program: Path) -> None:
    async with (
        asyncio.timeout(30),
        serve_anvil(program, host="127.0.0.1", port=0, block_time=0.1, state=None) as node,
        Node(node.url) as client,
    ):
        while await client.block_number() < 3:
            await asyncio.sleep(0.02)


async def test_an_anvil_that_ends_by_itself_ends_the_body_with_its_output(program: Path) -> None:
    async def serve() -> None:
        async with serve_anvil(program, host="127.0.0.1", port=0, block_time=None, state=None) as node:
            os.kill(node.pid, signal.SIGKILL)
            await asyncio.Event().wait()

    with raises_with(RemoteError, code="node-ended", match="by signal 9"):
        await asyncio.wait_for(serve(), 30)


async def test_a_failed_start_has_its_reason(tmp_path: Path) -> None:
    broken = tmp_path / "anvil"
    broken.write_text("#!/bin/sh\necho 'the disk is on fire'\nexit 3\n")
    broken.chmod(stat.S_IRWXU)
    with raises_with(RemoteError, code="node-ended", match="with exit code 3", hint="the disk is on fire"):
        async with serve_anvil(broken, host="127.0.0.1", port=0, block_time=None, state=None):
            pytest.fail("it serves")


async def test_cancelling_the_start_leaves_no_process(tmp_path: Path) -> None:
    slow = tmp_path / "anvil"
    slow.write_text(f"#!/bin/sh\necho $$ > {tmp_path}/pid\nexec sleep 600\n")
    slow.chmod(stat.S_IRWXU)

    async def serve() -> None:
        async with serve_anvil(slow, host="127.0.0.1", port=0, block_time=None, state=None):
            pytest.fail("it serves")

    serving = asyncio.create_task(serve())
    async with asyncio.timeout(30):
        while not (await asyncio.to_thread(_pid_in, tmp_path / "pid")):
            await asyncio.sleep(0.01)
    pid = _pid_in(tmp_path / "pid")
    serving.cancel()
    with pytest.raises(asyncio.CancelledError):
        await serving
    assert not is_alive(pid)


def _pid_in(path: Path) -> int:
    text = path.read_text().strip() if path.exists() else ""
    return int(text or 0)


async def test_a_taken_port_is_an_error(program: Path) -> None:
    async with serve_anvil(program, host="127.0.0.1", port=0, block_time=None, state=None) as node:
        port = int(node.url.rpartition(":")[2])
        with pytest.raises(PortUnavailable) as caught:
            async with serve_anvil(program, host="127.0.0.1", port=port, block_time=None, state=None):
                pytest.fail("it serves")
    assert (caught.value.code, caught.value.host, caught.value.port) == ("port-unavailable", "127.0.0.1", port)
    assert caught.value.why == os.strerror(errno.EADDRINUSE)


@pytest.mark.parametrize("content", [b"garbage", b"[]", b"{}", b"\xff"])
async def test_an_invalid_state_is_an_error_and_is_not_changed(program: Path, tmp_path: Path, content: bytes) -> None:
    state = tmp_path / "state.json"
    state.write_bytes(content)
    with pytest.raises(ConfigurationError, match=str(state)) as caught:
        async with serve_anvil(program, host="127.0.0.1", port=0, block_time=None, state=state):
            pytest.fail("it serves")
    assert caught.value.code == "invalid-chain-state"
    assert state.read_bytes() == content


async def test_a_kept_state_has_the_market_and_its_history(program: Path, tmp_path: Path) -> None:
    settings, state = Settings(data_dir=str(tmp_path)), tmp_path / "new" / "state.json"
    port = free_port()
    async with serve_chain(
        settings, host="127.0.0.1", port=port, block_time=None, anvil=program, state=state
    ) as served:
        async with served.market.chain(served.url, "person") as chain:
            await chain.tokens.transfer(NEW_ACCOUNT, 7 * XRT)
            head = await chain.node.heads.look()
        first = served
    async with serve_chain(settings, host="127.0.0.1", port=port, block_time=None, anvil=program, state=state) as again:
        assert again.facts() == first.facts()
        async with Chain(again.url) as chain:
            assert await chain.tokens.balance(NEW_ACCOUNT) == 7 * XRT
            assert await chain.tokens.balance(again.market.accounts["person"].address) == ALLOWANCE - 7 * XRT
            assert await chain.node.header(head.number) == head
            assert list((await chain.lighthouses.get("airalab")).stakes) == [again.market.accounts["provider"].address]


async def test_a_kept_chain_without_a_market_is_an_error(program: Path, tmp_path: Path) -> None:
    state = tmp_path / "state.json"
    async with (
        serve_anvil(program, host="127.0.0.1", port=0, block_time=None, state=state) as node,
        Node(node.url) as client,
    ):
        await TransactionSender(client, Account(node.funded_keys[0])).send(to=NEW_ACCOUNT, data=b"", value=1)
    with raises_with(ConfigurationError, code="market-missing", match=str(state)):
        async with serve_chain(
            Settings(data_dir=str(tmp_path)), host="127.0.0.1", port=0, block_time=None, anvil=program, state=state
        ):
            pytest.fail("it serves")


def test_anvil_is_found_on_the_path_or_by_its_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    assert find_anvil(None) is None
    program = tmp_path / "anvil"
    program.write_text("#!/bin/sh\n")
    with raises_with(ConfigurationError, code="not-a-program", match=str(program)):
        find_anvil(program)
    program.chmod(stat.S_IRWXU)
    assert find_anvil(None) == find_anvil(program) == program
