"""`aira up` as a separate process: which engine runs its chain, and whether its state is kept."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest
from click.testing import CliRunner

from mesh.chain import Node
from mesh.cli import main
from mesh.cli.errors import AnvilMissing
from tests.mesh.cli.served_chain import columns
from tests.support.commands import AIRA, Serving, refused
from tests.support.peers import require
from tests.support.ports import free_port

if TYPE_CHECKING:
    from pathlib import Path


def up(folder: Path, *options: str | Path, **variables: str) -> Serving:
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    arguments = ("--port", "0", "--listen", endpoint, "--data-dir", folder, *options)
    return Serving(*AIRA, "up", *arguments, says="provider    0x", variables=variables)


@pytest.mark.full
def test_anvil_on_the_path_is_used(tmp_path: Path, on_path: dict[str, str]) -> None:
    with up(tmp_path, **on_path) as server:
        assert columns(server.log())["engine"] == f"anvil ({tmp_path}/programs/anvil)"


def kept_withdrawals(folder: Path) -> int:
    return len(list(folder.rglob("withdrawals-*.sqlite")))


@pytest.mark.full
async def test_the_chain_is_kept_in_a_file(tmp_path: Path) -> None:
    options = ("--anvil", require("anvil"), "--state", tmp_path / "chain.json")
    first_blocks = []
    for _ in range(2):
        with up(tmp_path, *options) as server:
            async with Node(columns(server.log())["chain"]) as node:
                first_blocks.append(await node.header(1))
    assert first_blocks[0] == first_blocks[1]
    assert kept_withdrawals(tmp_path) == 2  # of one chain, for the market of each generation


def test_a_state_file_without_anvil_is_one_clear_line(tmp_path: Path) -> None:
    options = ["--engine", "embedded", "--state", str(tmp_path / "chain.json")]
    done = CliRunner().invoke(main, ["up", "--listen", f"tcp/127.0.0.1:{free_port()}", *options])
    refused(done, AnvilMissing, "--state")
