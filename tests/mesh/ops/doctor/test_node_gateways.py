"""Nodes behind a gateway: one that answers some methods only, and one whose clock is not ours."""

from __future__ import annotations

import http.server
import json
import threading
import time
import urllib.request
from contextlib import contextmanager
from email.utils import formatdate
from typing import TYPE_CHECKING, Any

from mesh.ops.doctor import CheckStatus

if TYPE_CHECKING:
    from collections.abc import Iterator

    from tests.support.doctor.machines import Machine

HOUR = 3600
GETH = "Geth/v1.14.0-stable"


@contextmanager
def gateway(node: str, *, behind: float = 0.0, refused: tuple[str, ...] = ()) -> Iterator[str]:
    """A gateway to `node` that claims to be Geth, `behind` seconds late; `refused` methods fail."""

    class Gateway(http.server.BaseHTTPRequestHandler):
        def do_POST(self) -> None:
            asked = self.rfile.read(int(self.headers["Content-Length"]))
            body = json.dumps(self.answer(json.loads(asked), asked)).encode()
            self.send_response(200)
            self.send_header("Content-Length", str(len(body)))
            self.end_headers()
            self.wfile.write(body)

        def answer(self, question: dict[str, Any], asked: bytes) -> dict[str, Any]:
            about = {"jsonrpc": "2.0", "id": question["id"]}
            if question["method"] in refused:
                return about | {"error": {"code": -32601, "message": "the method is not available here"}}
            if question["method"] == "web3_clientVersion":
                return about | {"result": GETH}
            request = urllib.request.Request(node, asked, {"Content-Type": "application/json"})
            with urllib.request.urlopen(request, timeout=30) as replied:
                found: dict[str, Any] = json.load(replied)
            if question["method"] == "eth_getBlockByNumber":
                found["result"]["timestamp"] = hex(int(time.time() - behind))
            return found

        def date_time_string(self, timestamp: float | None = None) -> str:
            return formatdate(time.time() - behind, usegmt=True)

        def log_message(self, format: str, *args: Any) -> None:
            pass

    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), Gateway)
    thread = threading.Thread(target=server.serve_forever)
    thread.start()
    try:
        yield f"http://127.0.0.1:{server.server_address[1]}"
    finally:
        server.shutdown()
        thread.join()
        server.server_close()


async def test_a_gateway_without_some_methods_passes(machine: Machine) -> None:
    with gateway(machine.town.url, refused=("web3_clientVersion", "eth_syncing")) as url:
        found = await machine.examined("agent", "robot", web3_http_provider=url)

    assert found.failed == []
    assert found.one("node").status is CheckStatus.OK


async def test_a_clock_ahead_is_not_reported_as_a_stalled_node(machine: Machine) -> None:
    with gateway(machine.town.url, behind=HOUR) as url:
        found = await machine.examined("agent", "robot", web3_http_provider=url)

    assert found.cause("node clock").code == "clock-off"
    assert "60 minutes ahead" in found.cause("node clock").message
