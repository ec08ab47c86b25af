"""Servers of bridges: certificates that can't be used; who and what a door refuses, whichever it is."""

from __future__ import annotations

import io
import json
from contextlib import asynccontextmanager
from typing import TYPE_CHECKING

import aiohttp
import pytest

from bridges.mcp._http import McpOptions
from bridges.serving import DoorOptions, ServerOptions
from mesh.errors import ConfigurationError
from mesh.signer.protocol import LARGEST_REQUEST
from tests.support.a2a import clients as a2a
from tests.support.commands import invoke, refused
from tests.support.doors import TOKEN
from tests.support.mcp import clients as mcp

if TYPE_CHECKING:
    from collections.abc import AsyncIterator
    from pathlib import Path

DOORS = [
    ("mcp", "--http", "127.0.0.1:0"),
    ("a2a", "--http", "127.0.0.1:0"),
]


@pytest.mark.parametrize(
    ("certificate", "key", "why"),
    [("nothing.pem", "nothing.key", "No such file"), ("no.pem", "no.pem", "not a certificate"), ("no.pem", "", "none")],
)
def test_a_certificate_that_can_not_be_used_is_an_error(tmp_path: Path, certificate: str, key: str, why: str) -> None:
    (tmp_path / "no.pem").write_text("no certificate")
    options = ServerOptions(certificate=str(tmp_path / certificate), key=str(tmp_path / key) if key else "")
    with pytest.raises(ConfigurationError, match=why) as caught:
        options.tls()
    assert caught.value.code == "tls-unusable"


@pytest.mark.parametrize("words", DOORS, ids=" ".join)
def test_a_door_says_so_in_one_line(tmp_path: Path, words: tuple[str, ...]) -> None:
    files = ("--certificate", tmp_path / "nothing.pem", "--key", tmp_path / "nothing.key")
    done = invoke(*words, *files, "--data-dir", tmp_path)
    refused(done, ConfigurationError, code="tls-unusable")


@pytest.mark.parametrize(
    ("host", "is_known"),
    [
        ("127.0.0.1", True),
        ("LOCALHOST:80", True),
        ("[::1]:80", True),
        ("10.0.0.7:80", True),
        ("robots.example", True),
        ("Door.Example:443", True),
        ("other.example", False),
        ("127.0.0.1.other.example", False),
        ("", False),
        ("[", False),
    ],
)
def test_a_door_is_reached_by_its_names_only(host: str, is_known: bool) -> None:
    options = DoorOptions(host="10.0.0.7", names=("robots.example",), url="https://door.example/mcp")
    assert options.knows_host(host) is is_known


NAMES = ("robots.example",)
CALLS = {"mcp": (mcp.CALL, mcp.HEADERS), "a2a": (a2a.CALL, a2a.AUTHORIZED)}


@asynccontextmanager
async def serving(door: str, folder: Path) -> AsyncIterator[str]:
    """A door in this process, of a signer that does not run; its URL."""
    if door == "mcp":
        async with mcp.served(McpOptions(token=TOKEN, names=NAMES)) as url:
            yield url
    else:
        async with a2a.serving(a2a.NOWHERE, folder, names=NAMES) as served:
            yield served.url


async def answered(door: str, folder: Path, headers: dict[str, str], body: bytes = b"") -> int:
    """The status of the answer to a request."""
    call, given = CALLS[door]
    data = io.BytesIO(body or json.dumps(call).encode())
    known = given | {"Authorization": f"Bearer {TOKEN}"} | headers
    async with (
        serving(door, folder) as url,
        aiohttp.ClientSession() as session,
        session.post(url, data=data, headers=known) as response,
    ):
        return response.status


@pytest.mark.parametrize("door", CALLS)
@pytest.mark.parametrize(
    ("header", "value", "status"),
    [
        ("Host", "evil.example", 421),
        ("Host", "127.0.0.1.evil.example:80", 421),
        ("Origin", "http://evil.example", 403),
        ("Origin", "null", 403),
        ("Host", "robots.example", 200),
        ("Origin", "http://localhost:3000", 200),
    ],
)
async def test_pages_of_other_sites_reach_nothing(
    tmp_path: Path, door: str, header: str, value: str, status: int
) -> None:
    assert await answered(door, tmp_path, {header: value}) == status


@pytest.mark.parametrize("door", CALLS)
async def test_a_body_that_is_too_large_is_refused(tmp_path: Path, door: str) -> None:
    assert await answered(door, tmp_path, {}, b" " * (LARGEST_REQUEST + 1)) == 413
