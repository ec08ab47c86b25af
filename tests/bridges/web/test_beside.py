"""The page beside a market of one process: `aira up` and `aira demo --web`."""

from __future__ import annotations

import json
import re
import signal
import socket
import sys
import urllib.request
from typing import TYPE_CHECKING, Any

import pytest

from mesh.base.extras import PackageMissing
from mesh.dev.page import page_server
from mesh.errors import PortUnavailable
from tests.support.commands import AIRA, Serving, invoke, refused
from tests.support.ports import free_port
from tests.support.waiting import wait_until

if TYPE_CHECKING:
    from pathlib import Path


def answer(url: str) -> Any:
    with urllib.request.urlopen(url, timeout=30) as response:
        return json.load(response)


def test_a_development_market_has_a_page_that_orders_for_the_person(tmp_path: Path) -> None:
    where = ("--listen", f"tcp/127.0.0.1:{free_port()}", "--port", "0", "--data-dir", tmp_path, "--web-port", "0")
    with Serving(*AIRA, "up", *where, "--engine", "embedded", "--local-account", says="provider    0x") as up:
        printed = dict(re.findall(r"^(page|person) +(.*)$", up.log(), re.MULTILINE))
        market = answer(f"{printed['page']}/api/v1/market")
        assert market["account"] == printed["person"].split()[-1]
        assert market["connected"] == {"router": True, "chain": True}
        code, _ = up.end(signal.SIGINT)
        assert code == 0, up.log()


def test_the_demo_leaves_the_page_open_on_its_finished_job() -> None:
    with Serving(*AIRA, "demo", "--web", "--web-port", "0", says="Ctrl-C ends everything") as demo:
        found = re.search(r"(http://\S+)/#/job/(0x\w{40})", demo.log())
        assert found
        url = f"{found[1]}/api/v1/liabilities/{found[2]}"
        wait_until(lambda: answer(url)["timeline"][-1]["kind"] == "paid", what="the payment on the page")
        kinds = [step["kind"] for step in answer(url)["timeline"]]
        assert kinds == ["created", "ready", "playing", "result", "paid"]
        assert answer(f"{found[1]}/api/v1/liabilities/{found[2]}/verification")["holds"]

        def robots() -> Any:
            agents = answer(f"{found[1]}/api/v1/agents")["agents"]
            return [agent for agent in agents if agent["role"] == "agent" and (agent["profile"] or agent["models"])]

        wait_until(lambda: [robot["profile"]["price"] for robot in robots()] == ["42 XRT"], what="the robot's price")
        (robot,) = robots()
        assert robot["profile"]["name"] == "Lamp"
        description = answer(f"{found[1]}/api/v1/models/{robot['models'][0]}")["description"]
        assert description["title"] == "Blink"
        code, _ = demo.end(signal.SIGINT)
        assert code == 0, demo.log()


def test_a_port_that_was_given_must_be_free() -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        refused(invoke("demo", "--web", "--web-port", str(port)), PortUnavailable, port)


def test_what_the_page_lacks_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in [name for name in sys.modules if name.startswith("bridges.web")]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "aiohttp.web", None)
    monkeypatch.delattr("aiohttp.web", raising=False)
    with pytest.raises(PackageMissing) as caught:
        page_server(None)
    assert caught.value.extra == "web"
    monkeypatch.setattr("mesh.dev.page.entry_points", lambda group: {})
    with pytest.raises(PackageMissing):
        page_server(None)


@pytest.mark.full
def test_the_page_goes_on_when_its_market_is_started_afresh(tmp_path: Path) -> None:
    endpoint, node, port = f"tcp/127.0.0.1:{free_port()}", free_port(), free_port()
    up = ("up", "--no-web", "--engine", "embedded", "--listen", endpoint, "--port", str(node), "--data-dir", tmp_path)
    of_market = ("--connect", endpoint, "--web3-http-provider", f"http://127.0.0.1:{node}")
    web = ("web", "--listen", f"127.0.0.1:{port}", *of_market, "--data-dir", tmp_path / "page")
    url = f"http://127.0.0.1:{port}/api/v1"

    def is_connected() -> bool:
        try:
            return bool(answer(f"{url}/market")["connected"] == {"router": True, "chain": True})
        except OSError:
            return False  # it opens again

    with Serving(*AIRA, *up, says="provider    0x") as market, Serving(*AIRA, *web, says="page  ") as page:
        wait_until(is_connected, what="the page on the chain")
        # Until it has read a block, it could not tell another chain of this length from this one.
        connected_at = answer(f"{url}/market")["block"]
        wait_until(lambda: answer(f"{url}/market")["block"] >= connected_at + 2, what="two more blocks on the page")
        market.end(signal.SIGINT)
        market.start()
        page.wait_until_said("the chain was started afresh")
        wait_until(is_connected, what="the page on the new chain", seconds=60)
        assert page.is_running
