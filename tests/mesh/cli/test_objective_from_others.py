"""`aira objective`: files of other peers, and objectives packed from live messages."""

from __future__ import annotations

import json
import signal
import threading
from typing import TYPE_CHECKING, Any

import pytest
import zenoh

from mesh.content import Exchange, Store
from mesh.content.store import ContentUnavailable
from mesh.errors import NetworkUnavailable
from mesh.network import Channel, Endpoints, Network
from mesh.recording import open_objective
from mesh.settings import Settings
from schemas import cid_of_bytes, cid_of_file
from schemas.payloads import RAW, STRING, String
from tests.support.cli.calls import call
from tests.support.commands import AIRA, SECONDS, Serving, aira, refused
from tests.support.objectives import objective
from tests.support.ports import free_endpoint
from tests.support.routers import client_config
from tests.support.waiting import wait_until

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from tests.support.routers import EmbeddedRouter


@pytest.fixture(autouse=True)
def own_data(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A store of this test's own."""
    monkeypatch.setenv("AIRA_DATA_DIR", str(tmp_path / "data"))


class Holder:
    """A peer that has a file."""

    def __init__(self, endpoint: str, folder: Path, content: bytes) -> None:
        self._endpoint = endpoint
        self._folder = folder
        self._content = content

    async def __aenter__(self) -> str:
        self._network = await Network(Endpoints(connect=(self._endpoint,))).__aenter__()
        self._store = Store(self._folder)
        cid = self._store.put_bytes(self._content)
        self._exchange = await Exchange(self._network.session, self._store).__aenter__()
        return cid

    async def __aexit__(self, *exc_info: Any) -> None:
        await self._exchange.__aexit__(None, None, None)
        self._store.close()
        await self._network.__aexit__(None, None, None)


async def test_a_file_is_fetched_from_a_peer(router: EmbeddedRouter, tmp_path: Path) -> None:
    import asyncio

    content = objective(("/go", "there"))
    async with Holder(router.endpoint, tmp_path / "theirs", content) as cid:
        words: list[str | Path] = ["objective", "get", cid, "--out", tmp_path / "it.mcap", "--connect", router.endpoint]
        done = await asyncio.to_thread(aira, *words)
        asking = f"aira: {cid} is not in the store; asking "  # said only if that takes a while
        assert (done.returncode, [line for line in done.stderr.splitlines() if not line.startswith(asking)]) == (0, [])
        assert (tmp_path / "it.mcap").read_bytes() == content
        done = await asyncio.to_thread(aira, "objective", "show", cid, "--connect", router.endpoint)
        assert done.stdout.splitlines()[0].split() == ["cid", cid]


def test_a_missing_file_and_a_missing_router_are_one_clear_line(router: EmbeddedRouter, tmp_path: Path) -> None:
    words: list[str | Path] = ["get", cid_of_bytes(b"nobody's"), "--out", tmp_path / "it", "--fetch-timeout", "0.2"]
    refused(call(*words, "--connect", router.endpoint), ContentUnavailable)
    nowhere = ["--connect", free_endpoint(), "--connect-timeout", "0.2"]
    refused(call(*words, *nowhere), NetworkUnavailable)
    refused(call("pack", "--hear", "a/**", "--out", tmp_path / "it", *nowhere), NetworkUnavailable)


async def test_a_fetch_says_whom_it_asks_and_when_it_gives_up(router: EmbeddedRouter, tmp_path: Path) -> None:
    import asyncio

    cid, robot = cid_of_bytes(b"nobody's"), f"0x{'1' * 40}"
    lighthouse = Settings().lighthouse_contract
    async with (
        Network(Endpoints(connect=(router.endpoint,))) as network,
        Channel(network.session, lighthouse) as channel,
    ):
        channel.announce("agent", robot)
        words: list[str | Path] = ["objective", "get", cid, "--out", tmp_path / "it", "--fetch-timeout", "2"]
        done = await asyncio.to_thread(aira, *words, "--connect", router.endpoint)
    notice, error, *_ = done.stderr.splitlines()
    assert f"[{ContentUnavailable.code}]" in error
    assert all(word in notice for word in (cid, "agent 0x1111…1111", router.endpoint, "2 s"))


class Speaker:
    """A device that publishes the same messages repeatedly until the context ends, and has begun with it."""

    def __init__(self, endpoint: str, key: str) -> None:
        self._endpoint = endpoint
        self._key = key
        self._speaks, self._stopped = threading.Event(), threading.Event()
        self._thread = threading.Thread(target=self._speak, name="speaker of the test")

    def __enter__(self) -> None:
        self._thread.start()
        assert self._speaks.wait(SECONDS)

    def __exit__(self, *exc_info: object) -> None:
        self._stopped.set()
        self._thread.join()

    def _speak(self) -> None:
        with zenoh.open(client_config(self._endpoint)) as session:
            while not self._stopped.wait(0.02):
                session.put(self._key, String("on").encode(), encoding=STRING.zenoh_encoding)
                session.put("elsewhere/x", b"\1")
                self._speaks.set()


DEVICE = f"aira/agent/0x{'1' * 40}/device/lamp"


@pytest.fixture
def speaker(router: EmbeddedRouter) -> Iterator[None]:
    with Speaker(router.endpoint, f"{DEVICE}/led/left"):
        yield


@pytest.mark.usefixtures("speaker")
def test_live_messages_are_packed_into_an_objective(router: EmbeddedRouter, tmp_path: Path) -> None:
    out = tmp_path / "heard.mcap"
    words: list[str | Path] = ["--hear", f"{DEVICE}/**", "--hear", "elsewhere/*", "--seconds", "1.5", "--out", out]
    done = call("pack", *words, "--connect", router.endpoint, "--json")
    assert done.exit_code == 0, done.output
    said = json.loads(done.stdout)
    assert said["topics"] == ["/elsewhere/x", "/led/left"]
    types = {topic.name: topic.type for topic in open_objective(out).topics}
    assert types == {"/led/left": STRING, "/elsewhere/x": RAW}
    assert said["cid"] == cid_of_file(out)


@pytest.mark.usefixtures("speaker")
def test_ctrl_c_ends_the_capture_with_a_complete_file(router: EmbeddedRouter, tmp_path: Path) -> None:
    out = tmp_path / "heard.mcap"
    words: list[str | Path] = ["--hear", f"{DEVICE}/**", "--out", out, "--connect", router.endpoint]
    with Serving(*AIRA, "objective", "pack", *words, says="Ctrl-C stops it") as packing:
        wait_until(lambda: any(file.stat().st_size for file in tmp_path.glob("*heard.mcap*")), what="messages in it")
        code, _ = packing.end(signal.SIGINT)
        said = packing.log()
    assert (code, cid_of_file(out) in said.split()) == (0, True), said
    assert open_objective(out).count > 0


def test_without_messages_no_file_is_left(router: EmbeddedRouter, tmp_path: Path) -> None:
    out = tmp_path / "it.mcap"
    words: list[str | Path] = ["--hear", "silence/**", "--seconds", "0.2", "--out", out, "--connect", router.endpoint]
    refused(call("pack", *words), "nothing-recorded", "silence/**")
    assert not out.exists()
