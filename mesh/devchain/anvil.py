"""Anvil, Foundry's development node, as a child process: faster than the embedded chain, and able to keep its state in
a file."""

from __future__ import annotations

import asyncio
import ctypes
import json
import shutil
import signal
import sys
import tempfile
from collections import deque
from contextlib import AsyncExitStack, asynccontextmanager, suppress
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Final, NoReturn

from mesh.background import Background
from mesh.devchain.anvil_state import STATE_SECONDS, copy_states, prepare_state
from mesh.devchain.errors import NotAProgram
from mesh.devchain.ports import check_port
from mesh.errors import ConfigurationError, RemoteError

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable, Sequence

START_SECONDS: Final = 60.0
STOP_SECONDS: Final = 10.0
"""Until a node that was asked to stop is killed; it writes its state first."""
LOOK_SECONDS: Final = 0.02
KEPT_LINES: Final = 5
"""The last lines of its output that are shown when it ends by itself."""
PR_SET_PDEATHSIG: Final = 1
"""From `linux/prctl.h`."""


class NodeEnded(RemoteError, code="node-ended"):
    """The node's process ended without being asked to. `exit_code` is negative for a signal."""

    def __init__(self, program: Path, code: int, said: str) -> None:
        super().__init__(
            f"{program.name} ended by itself, {f'with exit code {code}' if code >= 0 else f'by signal {-code}'}",
            hint=said or "it said nothing",
        )
        self.exit_code = code


def find_anvil(program: Path | None) -> Path | None:
    """Where anvil is: the named program, else the one on the path; None if there is none.

    Raises `NotAProgram` when the named one is not a program.
    """
    found = shutil.which(program or "anvil")
    if found is None and program is not None:
        raise NotAProgram(program)
    return Path(found) if found else None


class Anvil:
    """A running anvil: its address, and the private keys of the accounts that it funds."""

    def __init__(self, program: Path, process: asyncio.subprocess.Process, *, host: str, port: int) -> None:
        self.url = f"http://{f'[{host}]' if ':' in host else host}:{port}"
        self.funded_keys: tuple[bytes, ...] = ()
        self._program = program
        self._process = process
        self._address = (host, port)
        self._output: deque[str] = deque(maxlen=KEPT_LINES)
        self._listening = asyncio.create_task(self._listen(), name="output of anvil")

    @property
    def pid(self) -> int:
        """The id of its process."""
        return self._process.pid

    async def until_ready(self, facts: Path) -> None:
        """Return when it answers and has written `facts`. Raises `NodeEnded`, `RemoteError` if it takes too long."""
        with suppress(TimeoutError):
            async with asyncio.timeout(START_SECONDS):
                while self._process.returncode is None:
                    if await self._answers() and (keys := _keys_in(facts)):
                        self.funded_keys = keys
                        return
                    await asyncio.sleep(LOOK_SECONDS)
        if self._process.returncode is None:
            raise RemoteError(f"{self._program} does not answer at {self.url} after {START_SECONDS:g} s")
        await self.watch()

    async def watch(self) -> NoReturn:
        """Wait until the process ends, and raise `NodeEnded`."""
        code = await self._process.wait()
        await self._listening
        raise NodeEnded(self._program, code, " | ".join(self._output))

    async def stop(self) -> None:
        """Stop the process and wait for its end."""
        with suppress(ProcessLookupError):
            self._process.terminate()
        try:
            async with asyncio.timeout(STOP_SECONDS):
                await self._process.wait()
        except TimeoutError:
            self._process.kill()
            await self._process.wait()
        self._listening.cancel()

    async def _answers(self) -> bool:
        try:
            _, writer = await asyncio.open_connection(*self._address)
        except OSError:
            return False
        writer.close()
        return True

    async def _listen(self) -> None:
        """Read its output, which would block it otherwise, and keep the last lines."""
        assert self._process.stdout is not None
        while chunk := await self._process.stdout.read(65_536):
            for line in chunk.decode(errors="replace").splitlines():
                if line.strip():
                    self._output.append("".join(letter for letter in line.strip() if letter.isprintable()))


@asynccontextmanager
async def serve_anvil(
    program: Path, *, host: str, port: int, block_time: float | None, state: Path | None, load: Path | None = None
) -> AsyncIterator[Anvil]:
    """Run anvil for the body, which is cancelled with `NodeEnded` when anvil ends by itself; port 0 takes a free one.

    Each transaction is mined at once; with `block_time` (seconds) empty blocks are mined as well. The chain is loaded
    from the file `state` if it exists, and kept in it; or it is loaded from the file `load`, and lost. Raises
    `ConfigurationError` for a port that is taken, and for an invalid state.
    """
    port = check_port(host, port)
    async with AsyncExitStack() as stack:
        facts = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="aira-anvil-"))) / "facts.json"
        command = ["--host", host, "--port", str(port), "--config-out", str(facts), "--quiet"]
        if block_time is not None:
            command += ["--block-time", f"{block_time:g}", "--mixed-mining"]
        if state is not None:
            await asyncio.to_thread(prepare_state, state)
            command += ["--state", str(state), "--state-interval", str(STATE_SECONDS)]
        elif load is not None:
            command += ["--load-state", str(load)]
        node = Anvil(program, await _start(program, command), host=host, port=port)
        stack.push_async_callback(node.stop)
        await node.until_ready(facts)
        tasks = await stack.enter_async_context(Background())
        tasks.start(node.watch(), "watch over anvil")
        if state is not None:
            tasks.start(copy_states(state), "copies of the chain")
        yield node


async def _start(program: Path, arguments: Sequence[str]) -> asyncio.subprocess.Process:
    """Start the process in its own group, so that a terminal's Ctrl-C reaches only this program, which ends both."""
    try:
        return await asyncio.create_subprocess_exec(
            program,
            *arguments,
            stdin=asyncio.subprocess.DEVNULL,
            stdout=asyncio.subprocess.PIPE,
            stderr=asyncio.subprocess.STDOUT,
            process_group=0,
            preexec_fn=_end_with_parent(),
        )
    except OSError as error:
        raise ConfigurationError(f"can't run {program}: {error.strerror}") from None


def _end_with_parent() -> Callable[[], None] | None:
    """What the child does first so that it ends with this process even if that is killed; only on Linux."""
    if sys.platform != "linux":
        return None
    prctl = ctypes.CDLL(None).prctl  # looked up here because little is safe between fork and exec
    return partial(prctl, PR_SET_PDEATHSIG, int(signal.SIGTERM))


def _keys_in(facts: Path) -> tuple[bytes, ...]:
    """The private keys in the file that anvil writes; empty while the file is incomplete."""
    try:
        return tuple(bytes.fromhex(key[2:]) for key in json.loads(facts.read_text())["private_keys"])
    except (OSError, ValueError):
        return ()
