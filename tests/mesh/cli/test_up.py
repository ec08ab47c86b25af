"""`aira up` as a separate process: which engine runs its chain, and whether its state is kept."""

from __future__ import annotations

import json
import socket
from contextlib import suppress
from typing import TYPE_CHECKING

import pytest

from mesh.chain import Node
from mesh.dev.page import PAGE_PORT
from tests.support.cli.served_chain import columns
from tests.support.commands import AIRA, Serving, aira
from tests.support.peers import require
from tests.support.ports import free_port
from tests.support.waiting import wait_until

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


def kept_providers(folder: Path) -> int:
    return len(list(folder.rglob("provider-*.sqlite")))


@pytest.mark.full
async def test_the_chain_is_kept_in_a_file(tmp_path: Path) -> None:
    options = ("--anvil", require("anvil"), "--state", tmp_path / "chain.json")
    first_blocks = []
    for _ in range(2):
        with up(tmp_path, *options) as server:
            async with Node(columns(server.log())["chain"]) as node:
                first_blocks.append(await node.header(1))
    assert first_blocks[0] == first_blocks[1]
    assert kept_providers(tmp_path) == 2  # of one chain, for the market of each generation


def test_the_page_is_at_a_free_port_if_the_usual_one_is_taken(tmp_path: Path) -> None:
    with socket.socket() as taken:
        with suppress(OSError):  # by another market on this machine
            taken.bind(("127.0.0.1", PAGE_PORT))
        with up(tmp_path, "--engine", "embedded") as server:
            page = columns(server.log())["page"]
    assert page.startswith("http://127.0.0.1:")
    assert not page.endswith(f":{PAGE_PORT}")


def test_it_prints_where_it_listens_and_how_to_use_it(tmp_path: Path) -> None:
    options = ("--engine", "embedded", "--port", "0", "--listen", "tcp/127.0.0.1:0", "--no-web", "--data-dir", tmp_path)
    with Serving(
        *AIRA, "up", *options, says="export AIRA_KEYFILE_PASSWORD_FILE", variables={"AIRA_GENERATION": "5"}
    ) as up:
        printed = up.log()
        lines = [line.removeprefix("export ") for line in printed.splitlines() if line.startswith("export ")]
        variables = dict(line.split("=", 1) for line in lines)
        shown = columns("\n".join(line for line in printed.splitlines() if not line.startswith("export ")))
        assert shown["lighthouse"] == "airalab.lighthouse.5.robonomics.eth"
        assert shown["router"] == variables["AIRA_CONNECT"] != "tcp/127.0.0.1:0"
        seen = aira("lighthouse", "list", "--json", **variables)
        assert seen.returncode == 0, seen.stderr
        peers = aira("peers", "--json", **variables)
        assert '"provider"' in peers.stdout, peers.stderr


def test_it_prints_the_same_for_programs(tmp_path: Path) -> None:
    options = ("--engine", "embedded", "--port", "0", "--listen", "tcp/127.0.0.1:0", "--no-web", "--data-dir", tmp_path)
    with Serving(*AIRA, "up", *options, "--json", says='"environment"') as up:
        wait_until(lambda: up.log().endswith("\n"), what="the whole line")
        facts = json.loads(up.log())
    assert facts["environment"]["AIRA_WEB3_HTTP_PROVIDER"] == facts["chain"]
    assert facts["lighthouseName"] == "airalab.lighthouse.3.robonomics.eth"
    assert [facts["environment"]["AIRA_CONNECT"]] == facts["router"]
