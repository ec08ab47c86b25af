"""`aira health`, and the servers that it asks: their answers while they start, work and wait."""

from __future__ import annotations

import json
import socket
import subprocess
import sys
import threading
from contextlib import contextmanager
from typing import TYPE_CHECKING

import pytest

from mesh.errors import ConfigurationError
from mesh.settings import Settings
from schemas.status import ALIVE
from tests.support.cli.served_chain import columns
from tests.support.commands import AIRA, Serving, invoke, refused
from tests.support.ports import free_port
from tests.support.scraping import health, scraped
from tests.support.waiting import until_found

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

LONG = 60.0
THIRD = Settings(generation=3).lighthouse_contract
FIFTH = Settings(generation=5).lighthouse_contract


@pytest.fixture
def listen() -> str:
    """The address on which a server of the test serves metrics."""
    return f"127.0.0.1:{free_port()}"


@contextmanager
def answering(answer: bytes) -> Iterator[str]:
    """Something that answers one question with these bytes; gives its address."""
    with socket.create_server(("127.0.0.1", 0)) as server:

        def answer_once() -> None:
            line, _ = server.accept()
            with line:
                line.recv(65_536)
                line.sendall(answer)

        thread = threading.Thread(target=answer_once)
        thread.start()
        yield f"http://127.0.0.1:{server.getsockname()[1]}"
        thread.join()


def test_a_healthy_router_ends_with_exit_code_0(listen: str) -> None:
    with Serving(
        *AIRA, "router", "--listen", f"tcp/127.0.0.1:{free_port()}", "--metrics-listen", listen, says="no roster: "
    ):
        done = invoke("health", "--url", f"http://{listen}")
        assert (done.returncode, done.stdout) == (0, "router  alive\n")
        as_json = invoke("health", "--json", AIRA_METRICS_LISTEN=listen)
        assert json.loads(as_json.stdout) == {"ok": True, "parts": {"router": "alive"}}
        everywhere = invoke("health", AIRA_METRICS_LISTEN=f"0.0.0.0:{listen.split(':')[1]}")
        assert (everywhere.returncode, everywhere.stdout) == (0, "router  alive\n")


async def test_aira_up_has_metrics_of_both_generations(listen: str, tmp_path: Path) -> None:
    options = ("--port", "0", "--listen", f"tcp/127.0.0.1:{free_port()}", "--data-dir", tmp_path)
    url = f"http://{listen}"
    command = (*AIRA, "up", "--engine", "embedded", *options, "--metrics-listen", listen)
    with Serving(*command, says="provider    0x") as server:
        assert columns(server.log())["engine"] == "embedded"
        status, parts = await health(url)
        assert (status, set(parts.values())) == (200, {ALIVE})
        assert parts.keys() == {
            "channel",
            *(f"{part} of {lighthouse}" for part in ("transactions", "listener") for lighthouse in (THIRD, FIFTH)),
        }
        metrics = await scraped(url)
        assert metrics.of_label("aira_orders_open", "lighthouse") == {THIRD, FIFTH}
        assert metrics("aira_account_eth_wei") > 0
        assert invoke("health", "--url", url).returncode == 0


async def test_a_chain_reports_its_block_number(listen: str, tmp_path: Path) -> None:
    options = ("--port", "0", "--engine", "embedded", "--data-dir", tmp_path)
    url = f"http://{listen}"
    with Serving(*AIRA, "chain", "up", *options, "--metrics-listen", listen, says="password"):

        async def is_well() -> bool:
            return await health(url) == (200, {"chain": ALIVE})

        await until_found(is_well, what="the chain", seconds=LONG)
        assert (await scraped(url))("aira_chain_head_block") > 0


async def test_a_provider_that_waits_for_its_node_is_unhealthy(listen: str, tmp_path: Path) -> None:
    keyfile, password = tmp_path / "key.json", tmp_path / "password"
    password.write_text("open sesame\n")
    assert invoke("account", "new", keyfile, "--password-file", password).returncode == 0
    node = f"http://127.0.0.1:{free_port()}"
    variables = {"AIRA_KEYFILE": str(keyfile), "AIRA_KEYFILE_PASSWORD_FILE": str(password)}
    options = ("--connect-timeout", "-1", "--web3-http-provider", node, "--data-dir", tmp_path)
    url = f"http://{listen}"
    with Serving(
        *AIRA, "provider", *options, "--metrics-listen", listen, says="the provider waits", variables=variables
    ):
        status, parts = await health(url)
        assert status == 503
        assert parts["start"].startswith("waits: ")
        assert node in parts["start"]
        done = invoke("health", "--url", url)
        assert (done.returncode, done.stderr) == (1, "")
        assert done.stdout.startswith("start  waits: ")


def test_an_invalid_listen_address_is_one_clear_line() -> None:
    done = invoke("router", "--metrics-listen", "9464", AIRA_LISTEN=f"tcp/127.0.0.1:{free_port()}")

    refused(done, "invalid-listen-address", "'9464'")


def test_a_closed_port_is_one_clear_line_and_code_1(listen: str) -> None:
    done = invoke("health", "--url", f"http://{listen}")

    refused(done, "health-unavailable", listen, "Connection refused")


def test_an_impossible_host_is_one_clear_line_and_code_1() -> None:
    done = invoke("health", "--url", "http://no..host:9464")

    refused(done, "health-unavailable", "no..host:9464")


def test_a_demand_does_not_serve_metrics(listen: str, tmp_path: Path) -> None:
    host, _, port = listen.rpartition(":")
    with socket.create_server((host, int(port))):
        options = ("--model", "Qm" + "a" * 44, "--objective", "Qm" + "b" * 44, "--keyfile", tmp_path / "none.json")
        password = ("--keyfile-password-file", tmp_path / "none")
        done = invoke("demand", *options, *password, AIRA_METRICS_LISTEN=listen)

    refused(done, ConfigurationError, "keyfile")


def test_a_late_answer_is_one_clear_line_and_code_1() -> None:
    with socket.create_server(("127.0.0.1", 0)) as silent:
        done = invoke("health", "--url", f"http://127.0.0.1:{silent.getsockname()[1]}", "--timeout", "0.2")

    refused(done, "health-unavailable", "127.0.0.1:", "timed out")


@pytest.mark.parametrize(
    "answer", [b"HTTP/1.0 200 OK\r\n\r\n<html>", b'HTTP/1.0 200 OK\r\n\r\n{"ok": 1}', b"HTTP/1.0 404 No\r\n\r\n"]
)
def test_another_http_server_is_one_clear_line_and_code_1(answer: bytes) -> None:
    with answering(answer) as url:
        done = invoke("health", "--url", url)

    refused(done, "health-unavailable", url.removeprefix("http://"))


def test_control_characters_of_an_answer_are_not_printed() -> None:
    with answering(b'HTTP/1.0 503 No\r\n\r\n{"ok": false, "parts": {"a\\u001b[2J": "b\\u001b[31m"}}') as url:
        done = invoke("health", "--url", url)

    assert done.returncode == 1
    assert "\x1b" not in done.stdout


@pytest.mark.parametrize(
    "url", ["127.0.0.1:9464", "https://127.0.0.1:9464", "http://127.0.0.1", "http://[", "http://:x"]
)
def test_an_invalid_address_is_one_clear_line_and_code_2(url: str) -> None:
    done = invoke("health", "--url", url)

    refused(done, "invalid-server-address", repr(url))


def test_it_imports_no_heavy_modules() -> None:
    program = """
import sys
sys.argv = ["aira", "health", "--url", "http://127.0.0.1:9"]
try:
    import mesh.cli; mesh.cli.main()
except SystemExit:
    heavy = ("web3", "zenoh", "asyncio", "prometheus_client", "aiohttp", "rich")
    print([name for name in heavy if name in sys.modules])
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=60, check=True)

    assert done.stdout == "[]\n"
