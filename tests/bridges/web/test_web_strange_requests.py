"""Strange requests: each has an answer that says what is wrong, and none is a failure of the server."""

from __future__ import annotations

import itertools
import logging
import math
import struct
from typing import TYPE_CHECKING, Any, Final

import msgspec
from yarl import URL

from bridges.web import server
from mesh.base.flood import Rate
from mesh.recording import pack
from mesh.recording.objective import Played
from schemas.payloads import payload_type
from tests.bridges.web.conftest import OWN
from tests.support.market import MODEL
from tests.support.objectives import objective

if TYPE_CHECKING:
    from pathlib import Path

    import pytest

    from tests.support.market import Place

PARTS = (
    "%00",
    "a%00b",
    "x" * 5000,
    "/".join("y" * 300 for _ in range(9)),
    "%2e%2e%2f" * 40,
    "..%2f..%2fetc%2fpasswd",
    "%ff%fe",
    "%ed%a0%80",
    "%F0%9F%98%80",
    "-1",
    "9" * 5000,
    "0x" + "0" * 40,
    "0x" + "f" * 40,
    MODEL,
    "a.eth",
    "..eth",
    "%e2%80%ae.eth",
    "%20",
    "%0d%0aX-A:%201",
)
NUMBERS = ("-5", "0", str(10**23), "9" * 5000, "1e308", "nan", "%00", "1.5", "%D9%A3")
DEEP = b"[" * 5000
BODIES = (
    b"",
    b"null",
    b"[]",
    b"{}",
    DEEP,
    b'{"a":' * 5000,
    b'{"token":' + DEEP + b"]" * 5000 + b"}",
    b"\xff\xfe{",
    b"NaN",
    b'"' + b"\\ud800" * 3 + b'"',
    b"1" * 5000,
    b'{"jsonrpc":"2.0","id":1,"method":"eth_call","params":' + DEEP + b"}",
    b'{"jsonrpc":"2.0","id":1' + b"0" * 4000 + b',"method":"eth_chainId"}',
    b'{"jsonrpc":"2.0","id":1,"method":"eth_getBalance","params":[1e308,{"a":-1},null,"\\u0000"]}',
    b'{"jsonrpc":"2.0","id":1,"method":"eth_getBlockByNumber","params":["0x' + b"f" * 70 + b'",true]}',
    b'{"jsonrpc":"2.0","id":1,"method":"eth_call","params":[{"to":"0x1","data":"zz","gas":"-0x1"},"latest"]}',
)


def strange_values(model: str) -> list[dict[str, Any]]:
    """Values of a form."""
    strange: tuple[Any, ...] = (None, -1, 10**23, 10**4000, 1e308, "\x00", "x" * 9000, [], {}, True, "//", "a/*/b")
    topics = [{"topic": one, "value": 1} for one in strange] + [{}]
    times = [{"topic": "/a", "at": one, "value": 1} for one in strange]
    return topics + times + [{"topic": "/a", "value": one} for one in strange]


def orders(cid: str) -> list[dict[str, Any]]:
    """Orders of the local account with one strange value each."""
    fair: dict[str, Any] = {"model": MODEL, "objective": cid, "cost": "0"}
    numbers = (-5, 0, -(10**23), 10**23, 2**63, 2**256, 10**4000)
    lifetimes = [fair | {"lifetime": one} for one in numbers]
    amounts = [
        fair | {name: str(one)} for name in ("cost", "validatorFee") for one in (-1, 10**77 * 9, "1e5", "٣", "", " 1")
    ]
    names = [
        fair | {name: one}
        for name in ("model", "objective", "token", "validator")
        for one in ("\x00", "x" * 5000, "..eth")
    ]
    return [*lifetimes, *amounts, *names]


STRANGE: Final = (
    ("application/json", b"1e308"),
    ("application/json", b"1" + b"0" * 4000),
    ("application/json", DEEP),
    ("application/json", b'{"a":{"b":-1e308},"c":[' + b"9" * 400 + b"]}"),
    ("application/json", b"NaN"),
    ("ros1;std_msgs/Float64", struct.pack("<d", math.inf)),
    ("ros1;std_msgs/Float64", struct.pack("<d", math.nan)),
    ("ros1;std_msgs/UInt64", b"\xff" * 8),
    ("ros1;std_msgs/String", b"\xff" * 8),
    ("ros1;sensor_msgs/CompressedImage", b"\xff" * 40),
)


async def test_strange_recordings_are_shown(serve: Any, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    times = [number * 2**60 for number in range(len(STRANGE) - 1)] + [2**64 - 1]
    played = [
        Played(f"t{number % 3}", payload, at, at, 0, payload_type(kind))
        for number, (at, (kind, payload)) in enumerate(zip(times, STRANGE, strict=True))
    ]
    pack(played, tmp_path / "strange.mcap")
    content = (tmp_path / "strange.mcap").read_bytes()
    async with serve(settings={"fetch_timeout": 0.05}) as browser:
        data = {"X-Aira-Request": "1", "Content-Type": "application/octet-stream"}
        cid = (await browser.post("objectives", content, headers=data))["cid"]
        assert (await browser.get(f"files/{cid}/summary"))["messages"] == len(STRANGE)
        assert len((await browser.get(f"files/{cid}/messages"))["messages"]) == len(STRANGE)
        for topic in ("t0", "t1", "t2"):
            await browser.get(f"files/{cid}/values", topic=topic)
        await browser.get(f"files/{cid}/preflight", model=MODEL)
        for number in range(len(STRANGE) + 1):
            async with browser.session.get(f"{browser.server.url}/api/v1/files/{cid}/images/{number}") as response:
                assert response.status in (200, 404)
    assert "Traceback" not in caplog.text


async def test_no_strange_request_is_a_failure_of_the_server(
    place: Place, serve: Any, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    unlimited = Rate(per_second=1e6, burst=1e6)
    for name in ("REQUESTS", "REQUESTS_IN_TOTAL", "REFUSED"):
        monkeypatch.setattr(server, name, unlimited)

    def failures() -> list[str]:
        return [record.getMessage() for record in caplog.records if record.levelno >= logging.ERROR]

    async with place.provider(), serve("person", {"fetch_timeout": 0.05}) as browser:
        base, session = browser.server.url, browser.session
        data = {"X-Aira-Request": "1", "Content-Type": "application/octet-stream"}
        cid = (await browser.post("objectives", objective(("/blink", "on")), headers=data))["cid"]

        async def ask(method: str, path: str, body: bytes | None = None) -> None:
            async with session.request(method, URL(base + path, encoded=True), data=body, headers=OWN) as response:
                said = await response.text()
                assert response.status < 500 or response.status in (502, 504), (method, path[:90], body, said)
                assert "Traceback" not in said
                assert response.status != 429, said
                assert not failures(), (method, path[:90], body, failures())

        for part in PARTS:
            await ask("GET", f"/{part}")
            await ask("HEAD", f"/{part}")
            await ask("GET", f"/api/v1/orders?model={part[:2000]}&signer={part[:99]}&kind={part[:99]}")
            await ask("GET", f"/api/v1/liabilities?party={part[:2000]}&state={part[:99]}&phase={part[:99]}")
        for route, part in itertools.product(browser.server.api.routes(), PARTS):
            if route.path != "/api/v1/stream":
                filled = route.path
                for name in ("address", "cid", "hash", "validator", "number", "action", "format"):
                    filled = filled.replace(f"{{{name}}}", part)
                await ask(route.method, filled, b"{}" if route.method == "POST" else None)
        for number in NUMBERS:
            await ask("GET", f"/api/v1/orders?limit={number}")
            await ask("GET", f"/api/v1/liabilities?limit={number}")
            await ask("GET", f"/api/v1/files/{cid}/messages?after={number}&limit={number}&topic={number}")
            await ask("GET", f"/api/v1/files/{cid}/values?topic={number}")
            await ask("GET", f"/api/v1/files/{cid}/images/{number}")
            await ask("GET", f"/api/v1/agents/{place.address('robot')}/logs?lines={number}")
            await ask("GET", f"/api/v1/validators/{place.address('robot')}?fee={number}")
        posts = [route.path for route in browser.server.api.routes() if route.method == "POST"]
        for path, body in itertools.product([*posts, "/api/v1/session"], BODIES):
            await ask("POST", path.replace("{address}", place.address("robot")).replace("{action}", "start"), body)
        for value in strange_values(MODEL):
            await ask("POST", "/api/v1/objectives/form", msgspec.json.encode({"model": MODEL, "values": [value]}))
        for order in orders(cid):
            await ask("POST", "/api/v1/local/orders", msgspec.json.encode(order))
        for name, path in (("order", "withdrawals"), ("liability", "refunds")):
            for one in ("", "\x00", "0x" + "f" * 40, "f" * 64, "x" * 5000):
                await ask("POST", f"/api/v1/local/{path}", msgspec.json.encode({name: one}))
