"""EVM nodes for tests."""

from __future__ import annotations

import json
import subprocess
from functools import cached_property
from typing import TYPE_CHECKING, Any

from eth_account.hdaccount import key_from_seed, seed_from_mnemonic

from mesh.dev._evm import MNEMONIC
from schemas import Signer
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


class Geth(Server):
    """A geth in development mode, chain id 1337, by the rules of today's Ethereum: it mines by itself.

    `block_time` (seconds) counts from the next start on; 0 is a block for each transaction. Its chain is kept from one
    start to the next. A kill takes away the blocks that were not written: the last two, about.
    """

    name = "geth"

    def __init__(self, *, block_time: int = 0) -> None:
        self._program: Path = require("geth")
        super().__init__()
        self.block_time = block_time
        self.port, self.ws_port, self._engine_port = free_port(), free_port(), free_port()
        self.url, self.ws_url = f"http://127.0.0.1:{self.port}", f"ws://127.0.0.1:{self.ws_port}"

    @cached_property
    def private_keys(self) -> tuple[bytes, ...]:
        """The keys of the ten accounts that hold 10,000 ether each: those of all development chains."""
        seed = seed_from_mnemonic(MNEMONIC, "")
        return tuple(bytes(key_from_seed(seed, f"m/44'/60'/0'/0/{number}")) for number in range(10))

    def command(self) -> Sequence[str | Path]:
        data = ["--datadir", str(self.folder / "data"), "--state.scheme", "hash"]
        if not (self.folder / "data").exists():
            genesis = self.folder / "genesis.json"
            genesis.write_text(json.dumps(self._genesis()))
            subprocess.run([self._program, "init", *data, genesis], check=True, capture_output=True, timeout=60)
        alone = ["--port", "0", "--nodiscover", "--maxpeers", "0", "--ipcdisable"]
        http = ["--http", "--http.addr", "127.0.0.1", "--http.port", str(self.port)]
        ws = ["--ws", "--ws.addr", "127.0.0.1", "--ws.port", str(self.ws_port)]
        mining = ["--dev", "--dev.period", str(self.block_time), "--gcmode", "archive"]
        return [self._program, *mining, *data, *alone, *http, *ws, "--authrpc.port", str(self._engine_port)]

    def is_ready(self) -> bool:
        return answers(self.port) and answers(self.ws_port)

    def _genesis(self) -> Any:
        """That of its development mode, without the fork that Ethereum does not have yet."""
        dump = [str(self._program), "--dev", "dumpgenesis"]
        genesis = json.loads(subprocess.run(dump, check=True, capture_output=True, timeout=60).stdout)
        config = genesis["config"]
        del config["bogotaTime"]
        config["blobSchedule"]["osaka"] = config["blobSchedule"]["prague"]
        genesis["gasLimit"] = hex(36_000_000)
        for key in self.private_keys:
            genesis["alloc"][Signer(key).address] = {"balance": hex(10**22)}
        return genesis


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
