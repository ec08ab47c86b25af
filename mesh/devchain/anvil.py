"""Anvil, the development node of others, as a process of this one's: faster than the embedded chain, and it can keep
its state in a file."""

from __future__ import annotations

import asyncio
import ctypes
import json
import shutil
import signal
import socket
import sys
import tempfile
from collections import deque
from contextlib import AsyncExitStack, asynccontextmanager, suppress
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Final, NoReturn

from mesh.background import Background
from mesh.devchain.anvil_state import STATE_SECONDS, copy_states, prepare_state, settle_state
from mesh.errors import ConfigurationError, RemoteError

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable, Sequence

START_SECONDS: Final = 60.0
STOP_SECONDS: Final = 10.0
"""Until a node that was asked to end is killed; it writes its state first."""
LOOK_SECONDS: Final = 0.02
KEPT_LINES: Final = 5
"""Lines of what it said last that are shown when it ends by itself."""
PR_SET_PDEATHSIG: Final = 1
"""From `linux/prctl.h`."""


class NodeEnded(RemoteError):
    """The node's process ended without being asked to. `code` is its exit code, negative for a signal."""

    code = "node-ended"

    def __init__(self, program: Path, code: int, said: str) -> None:
        super().__init__(
            f"{program.name} ended by itself, {f'with exit code {code}' if code >= 0 else f'by signal {-code}'}",
            hint=said or "it said nothing",
        )
        self.exit_code = code


def find_anvil(program: Path | None) -> Path | None:
    """Where anvil is: the named program, else the one on the path; None if there is none.

    Raises `ConfigurationError` when the named one is no program.
    """
    found = shutil.which(program or "anvil")
    if found is None and program is not None:
        raise ConfigurationError(f"{program} is not a program that can be run", hint="--anvil names the file `anvil`")
    return Path(found) if found else None


class Anvil:
    """A running anvil: where it answers, and the private keys of the accounts that it gives money."""

    def __init__(self, program: Path, process: asyncio.subprocess.Process, *, host: str, port: int) -> None:
        self.url = f"http://{f'[{host}]' if ':' in host else host}:{port}"
        self.funded_keys: tuple[bytes, ...] = ()
        self._program = program
        self._process = process
        self._address = (host, port)
        self._said: deque[str] = deque(maxlen=KEPT_LINES)
        self._listening = asyncio.create_task(self._listen(), name="output of anvil")

    @property
    def pid(self) -> int:
        """The id of its process."""
        return self._process.pid

    async def until_ready(self, facts: Path) -> None:
        """Return when it answers and has told its `facts`. Raises `NodeEnded`, `RemoteError` if it takes too long."""
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
        """Wait for its end, and raise `NodeEnded`."""
        code = await self._process.wait()
        await self._listening
        raise NodeEnded(self._program, code, " | ".join(self._said))

    async def stop(self) -> None:
        """End the process, by its own id, and wait for that."""
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
        """Keep the last lines of what it says; a pipe that nobody reads would stop it."""
        assert self._process.stdout is not None
        while chunk := await self._process.stdout.read(65_536):
            for line in chunk.decode(errors="replace").splitlines():
                if line.strip():
                    self._said.append("".join(letter for letter in line.strip() if letter.isprintable()))


@asynccontextmanager
async def serve_anvil(
    program: Path, *, host: str, port: int, block_time: float | None, state: Path | None
) -> AsyncIterator[Anvil]:
    """Run anvil for the body, which is cancelled with `NodeEnded` when anvil ends before it; port 0 takes a free one.

    Each transaction is mined at once; with `block_time` (seconds) an empty block as often as well. The chain is loaded
    from the file `state`, where it is there, and kept in it. Raises `ConfigurationError` for a port that is taken, and
    a state that is none.
    """
    port = _bindable(host, port)
    async with AsyncExitStack() as stack:
        facts = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="aira-anvil-"))) / "facts.json"
        command = ["--host", host, "--port", str(port), "--config-out", str(facts), "--quiet"]
        if block_time is not None:
            command += ["--block-time", f"{block_time:g}", "--mixed-mining"]
        if state is not None:
            await asyncio.to_thread(prepare_state, state)
            command += ["--state", str(state), "--state-interval", str(STATE_SECONDS)]
            stack.push_async_callback(asyncio.to_thread, settle_state, state)
        node = Anvil(program, await _start(program, command), host=host, port=port)
        stack.push_async_callback(node.stop)
        await node.until_ready(facts)
        tasks = await stack.enter_async_context(Background())
        tasks.start(node.watch(), "watch over anvil")
        if state is not None:
            tasks.start(copy_states(state), "copies of the chain")
        yield node


async def _start(program: Path, arguments: Sequence[str]) -> asyncio.subprocess.Process:
    """The process; in a group of its own, so that a terminal's Ctrl-C comes to this program alone, which ends both."""
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
    """What a new process does first, so that it ends with this one even if that is killed; Linux alone has it."""
    if sys.platform != "linux":
        return None
    prctl = ctypes.CDLL(None).prctl  # looked up here, as little as possible is safe between fork and exec
    return partial(prctl, PR_SET_PDEATHSIG, int(signal.SIGTERM))


def _keys_in(facts: Path) -> tuple[bytes, ...]:
    """The private keys that anvil tells in a file; none as long as it is not written to its end."""
    try:
        return tuple(bytes.fromhex(key[2:]) for key in json.loads(facts.read_text())["private_keys"])
    except (OSError, ValueError):
        return ()


def _bindable(host: str, port: int) -> int:
    """The port, or a free one instead of 0. Raises `ConfigurationError` when it can't be had."""
    try:
        with socket.socket(socket.AF_INET6 if ":" in host else socket.AF_INET) as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            probe.bind((host, port))
            taken: int = probe.getsockname()[1]
            return taken
    except OSError as error:
        raise ConfigurationError(
            f"can't listen on {host}:{port}: {error.strerror}", hint="another node may run there; choose another port"
        ) from None
