"""EVM nodes for tests."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING

from tests.support.peers import require
from tests.support.ports import answers, free_port
from tests.support.processes import Server
from tests.support.waiting import wait_until

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


def written_state(state: Path, block: int) -> bytes:
    """The file with an anvil's state, once it has the block: a killed node loses later ones."""
    content = b""

    def has_block() -> bool:
        nonlocal content
        try:
            content = state.read_bytes()
            return int(json.loads(content)["best_block_number"]) >= block
        except (OSError, ValueError):
            return False  # it is being written

    wait_until(has_block, what=f"block {block} in {state}")
    return content
