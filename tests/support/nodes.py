"""EVM nodes for tests."""

from __future__ import annotations

import json
import time
from contextlib import suppress
from typing import TYPE_CHECKING

from tests.support.peers import require
from tests.support.ports import answers, free_port
from tests.support.processes import Server

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path


class Anvil(Server):
    """An anvil node, chain id 31337, that mines a block for each transaction unless `arguments` change that.

    Its chain is in memory: `stop` and `start` begin a new one on the same port, unless `arguments` name a state file.
    """

    name = "anvil"

    def __init__(self, *, port: int | None = None, arguments: Sequence[str] = ()) -> None:
        self._program: Path = require("anvil")
        super().__init__()
        self.port = port or free_port()
        self.url = f"http://127.0.0.1:{self.port}"
        self.ws_url = f"ws://127.0.0.1:{self.port}"
        self._arguments = tuple(arguments)

    @property
    def private_keys(self) -> tuple[bytes, ...]:
        """The keys of the ten accounts that hold 10,000 ether each; always the same ones."""
        made = json.loads(self._facts.read_text())
        return tuple(bytes.fromhex(key.removeprefix("0x")) for key in made["private_keys"])

    def command(self) -> Sequence[str | Path]:
        at = ["--host", "127.0.0.1", "--port", str(self.port), "--config-out", str(self._facts)]
        return [self._program, *at, *self._arguments]

    def is_ready(self) -> bool:
        return answers(self.port) and self._facts.exists() and self._facts.stat().st_size > 0

    @property
    def _facts(self) -> Path:
        return self.folder / "anvil.json"


def written_state(state: Path) -> bytes:
    """The file of an anvil's state with all blocks of now: what it writes the second time from now."""

    def written_at() -> int:
        return state.stat().st_mtime_ns if state.exists() else 0

    for _ in range(2):
        before = written_at()
        while written_at() == before:
            time.sleep(0.02)
    while True:
        written = state.read_bytes()
        with suppress(ValueError):  # while it is being written
            json.loads(written)
            return written
        time.sleep(0.02)
