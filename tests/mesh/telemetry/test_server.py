"""The two pages over HTTP: valid and invalid requests, slow clients, and addresses that can't be used."""

from __future__ import annotations

import socket
import subprocess
import sys
import time
from contextlib import ExitStack, closing, suppress
from typing import TYPE_CHECKING

import pytest

from mesh.base.door import DoorLimits
from mesh.errors import ConfigurationError
from mesh.telemetry._server import LIMITS, TelemetryServer
from mesh.telemetry.metrics import Health, counter, listen_address
from mesh.telemetry.serving import open_server
from tests.support.ports import free_port
from tests.support.raising import raises_with
from tests.support.scraping import Scrape, get
from tests.support.waiting import at_most

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator

    from mesh.telemetry.metrics import MetricFamily

WELL = Health.of({"channel": "alive"})
SECRET = "x-not-to-be-repeated"


def some() -> Iterable[MetricFamily]:
    return [counter("aira_some_total", "Some", 7)]


def serving(
    *, families: Callable[[], Iterable[MetricFamily]] = some, health: Callable[[], Health] = lambda: WELL
) -> TelemetryServer:
    return open_server("127.0.0.1:0", families, health)


@pytest.fixture
def url() -> Iterator[str]:
    """A server's address."""
    with serving() as running:
        yield running.url


def connected(url: str) -> socket.socket:
    host, _, port = url.removeprefix("http://").rpartition(":")
    return socket.create_connection((host, int(port)), timeout=30)


def said(url: str, request: bytes) -> bytes:
    """All that is answered to some bytes, until the server closes the connection, perhaps without reading them all."""
    answer = b""
    with connected(url) as line, suppress(ConnectionError):
        line.sendall(request)
        with suppress(OSError):  # it has closed it already
            line.shutdown(socket.SHUT_WR)
        while received := line.recv(65_536):
            answer += received
    return answer


def trickle(line: socket.socket) -> None:
    """Send for ever, a byte at a time. Raises `OSError` when the other side has closed the line."""
    while True:
        line.sendall(b"G")
        time.sleep(0.01)


def test_metrics_and_health_are_served(url: str) -> None:
    assert Scrape(get(url, "/metrics").text)("aira_some_total") == 7
    assert get(url, "/health")[:2] == (200, '{"ok":true,"parts":{"channel":"alive"}}\n')
    assert get(url, "/health?x=1").status == 200
    assert get(url, "/health").headers["Content-Type"] == "application/json"


def test_an_unhealthy_role_answers_503_with_its_parts() -> None:
    with serving(health=lambda: Health.of({"channel": "waits for a router"})) as running:
        assert get(running.url, "/health")[:2] == (
            503,
            '{"ok":false,"parts":{"channel":"waits for a router"}}\n',
        )


def test_a_head_has_the_length_and_no_body(url: str) -> None:
    page = get(url, "/health", method="HEAD")

    assert (page.status, page.text, page.headers["Content-Length"]) == (200, "", "40")


@pytest.mark.parametrize("path", ["/", "/metrics/", "/metric", "/../metrics", "/health/../../etc/passwd", f"/{SECRET}"])
def test_any_other_path_is_404_and_not_repeated(url: str, path: str) -> None:
    page = get(url, path)

    assert (page.status, page.text) == (404, "not found; the pages are /metrics and /health\n")


@pytest.mark.parametrize("method", ["POST", "PUT", "DELETE", "OPTIONS", "TRACE", "CONNECT", "PROPFIND"])
def test_other_methods_are_refused(url: str, method: str) -> None:
    page = get(url, "/health", method=method)

    assert page.status == 405
    assert "health" not in page.text


@pytest.mark.parametrize(
    "request_",
    [
        b"\r\n\r\n",
        b"GET\r\n\r\n",
        b"GET /health HTTP/9.9\r\n\r\n",
        b"GET /" + b"a" * 70_000 + b" HTTP/1.1\r\n\r\n",
        b"GET /nothing HTTP/1.1\r\n" + b"x: y\r\n" * 1000 + b"\r\n",
        b"GET /nothing HTTP/1.1\r\nx: " + b"y" * 70_000 + b"\r\n\r\n",
        b"\x16\x03\x01\x02\x00\x01\x00\x01\xfc\x03\x03" + bytes(range(256)),
        f"{SECRET} {SECRET} HTTP/1.1\r\n\r\n".encode(),
        f"GET /<b>{SECRET}</b> HTTP/1.1\r\nHost: {SECRET}\r\n\r\n".encode(),
    ],
)
def test_a_malformed_request_is_refused_and_the_next_one_answered(url: str, request_: bytes) -> None:
    answer = said(url, request_)

    assert not answer.startswith((b"HTTP/1.0 2", b"HTTP/1.1 2"))
    assert SECRET.encode() not in answer or b"Content-Type: text/plain" in answer  # a browser shows it, and no more
    assert get(url, "/health").status == 200


def test_a_client_that_sends_byte_by_byte_is_disconnected() -> None:
    limits = DoorLimits(head=0.5)
    with (
        TelemetryServer("127.0.0.1", 0, families=some, health=lambda: WELL, limits=limits) as running,
        at_most(20),
        connected(running.url) as slow,
        pytest.raises(OSError, match=r"\w"),
    ):
        trickle(slow)


def test_whoever_asks_is_answered_among_connections_that_ask_nothing(url: str) -> None:
    with ExitStack() as stack:
        silent = [stack.enter_context(closing(connected(url))) for _ in range(3 * LIMITS.connections)]
        for _ in range(5):
            assert get(url, "/health").status == 200
        assert silent[0].recv(1) == b""  # the one that waited longest has made room


def test_a_failure_is_answered_without_its_details(caplog: pytest.LogCaptureFixture) -> None:
    def fail() -> Iterable[MetricFamily]:
        raise ZeroDivisionError(SECRET)

    with serving(families=fail) as running:
        page = get(running.url, "/metrics")
        assert (page.status, page.text) == (500, "failed; the server's log says why\n")
        assert get(running.url, "/health").status == 200
    assert SECRET in caplog.text


@pytest.mark.parametrize("host", ["192.0.2.1", "no..host", "a" * 70])
def test_an_unusable_host_is_a_configuration_error(host: str) -> None:
    listen = f"{host}:{free_port()}"
    with raises_with(ConfigurationError, code="metrics-not-served") as raised:
        open_server(listen, some, lambda: WELL).__enter__()
    assert listen in str(raised.value)


@pytest.mark.parametrize("listen", ["9464", ":9464", "host:", "host:x", "host:65536", "host:-1", "::1:9464", "[]:1"])
def test_a_malformed_listen_address_is_a_configuration_error(listen: str) -> None:
    with raises_with(ConfigurationError, code="invalid-listen-address"):
        listen_address(listen)


@pytest.mark.parametrize(
    ("listen", "found"),
    [("0.0.0.0:9464", ("0.0.0.0", 9464)), ("[::1]:0", ("::1", 0)), ("localhost:80", ("localhost", 80))],
)
def test_a_listen_address_is_parsed(listen: str, found: tuple[str, int]) -> None:
    assert listen_address(listen) == found


def test_ipv6_is_served() -> None:
    with open_server("[::1]:0", some, lambda: WELL) as running:
        assert running.url.startswith("http://[::1]:")
        assert get(running.url, "/health").status == 200


def test_the_port_is_free_after_closing() -> None:
    with serving() as running:
        listen = running.url.removeprefix("http://")
        get(running.url, "/health")
    with open_server(listen, some, lambda: WELL) as again:
        assert get(again.url, "/health").status == 200


def test_without_prometheus_client_it_is_a_configuration_error() -> None:
    program = """
import sys
sys.modules["prometheus_client"] = None
from mesh.errors import ConfigurationError
from mesh.telemetry.serving import open_server
try:
    open_server("127.0.0.1:0", list, None)
except ConfigurationError as error:
    print(error, "|", error.hint)
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=60, check=True)

    assert done.stdout == (
        "metrics_listen needs the package prometheus_client, which is not installed | "
        "in a clone of aira-mesh: pip install '.[metrics]'\n"
    )
