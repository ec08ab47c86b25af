"""Anvil, Foundry's development node, as a child process: faster than the embedded chain, and able to keep its state in
a file.

Anvil rewrites that file in place again and again; a process that is killed meanwhile leaves half of it. So copies of
whole states are kept beside it.
"""

from __future__ import annotations

import asyncio
import ctypes
import logging
import shutil
import signal
import socket
import sys
import tempfile
from collections import deque
from contextlib import AsyncExitStack, asynccontextmanager, suppress
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Final, NamedTuple, NoReturn

from mesh.base.background import Background
from mesh.base.log_context import log_event
from mesh.base.private_files import atomic_file
from mesh.errors import ConfigurationError, PortUnavailable, RemoteError
from schemas.decoding import InvalidData, decode_json

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable, Sequence


def check_port(host: str, port: int) -> int:
    """The port, or a free one for 0. Raises `PortUnavailable` when it is taken."""
    try:
        with socket.socket(socket.AF_INET6 if ":" in host else socket.AF_INET) as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            probe.bind((host, port))
            free: int = probe.getsockname()[1]
            return free
    except OSError as error:
        raise PortUnavailable(host, port, str(error.strerror)) from None


log = logging.getLogger(__name__)


class AnvilPace(NamedTuple):
    """How long anvil may take, in seconds."""

    saving: int = 2
    """Between two saves of the state: a power cut costs at most two of these."""
    starting: float = 60.0
    """Until it answers."""
    stopping: float = 10.0
    """Until a node that was asked to stop is killed; it writes its state first."""
    looking: float = 0.02
    """Between two looks at whether it answers."""


ANVIL_PACE: Final = AnvilPace()


def prepare_state(state: Path) -> None:
    """Make sure that `state` is a file that anvil can load, or absent; half a chain is replaced by the last whole one.

    Raises `ConfigurationError` for a file that is no chain and has no copy, and a folder that can't be written to.
    """
    try:
        state.parent.mkdir(parents=True, exist_ok=True)
        if not state.exists() or _is_chain(state.read_bytes()):
            return
        whole = state_copy(state).read_bytes() if state_copy(state).exists() else b""
        if not _is_chain(whole):
            raise ConfigurationError(
                f"{state} does not contain a chain of anvil",
                hint="name another file, or remove it",
                code="invalid-chain-state",
            )
        _write(state, whole)
    except OSError as error:
        raise ConfigurationError(f"can't keep the chain in {state}: {error.strerror}") from None
    log.warning(
        "%s was cut off: using the last complete copy", state, extra=log_event("chain-state-restored", path=state)
    )


async def copy_states(state: Path) -> NoReturn:
    """Copy each whole state that anvil saves, until cancelled. Raises `ConfigurationError` when it can't."""
    seen = 0
    while True:
        await asyncio.sleep(ANVIL_PACE.saving)
        try:
            seen = await asyncio.to_thread(_copy_state, state, seen)
        except OSError as error:
            raise ConfigurationError(f"can't keep the chain in {state_copy(state)}: {error.strerror}") from None


def write_state(state: Path, content: bytes) -> None:
    """Write a whole chain to `state` in one step, and its copy. Raises `ConfigurationError` when it can't."""
    try:
        _write(state_copy(state), content)
        _write(state, content)
    except OSError as error:
        raise ConfigurationError(f"can't keep the chain in {state}: {error.strerror}") from None


def state_copy(state: Path) -> Path:
    """The file with the last whole state."""
    return state.with_name(f"{state.name}.kept")


def _copy_state(state: Path, seen: int) -> int:
    """Copy a whole state, unless it was `seen`; the time of its last change (nanoseconds)."""
    written = state.stat().st_mtime_ns if state.exists() else seen
    if written != seen and _is_chain(content := state.read_bytes()):
        _write(state_copy(state), content)
    return written


def _write(path: Path, content: bytes) -> None:
    with atomic_file(path) as file:
        file.write(content)


def _is_chain(content: bytes) -> bool:
    """Whether this is a whole state of anvil's."""
    try:
        found = decode_json(content)
    except InvalidData:
        return False
    return isinstance(found, dict) and "accounts" in found


def find_anvil(program: Path | None) -> Path | None:
    """Where anvil is: the named program, else the one on the path; None if there is none.

    Raises `ConfigurationError` (`not-a-program`) when the named one is not a program.
    """
    found = shutil.which(program or "anvil")
    if found is None and program is not None:
        raise ConfigurationError(
            f"{program} is not a program that can be run", hint="--anvil names the file `anvil`", code="not-a-program"
        )
    return Path(found) if found else None


class Anvil:
    """A running anvil: its address, and the private keys of the accounts that it funds."""

    def __init__(self, program: Path, process: asyncio.subprocess.Process, *, host: str, port: int) -> None:
        self.url = f"http://{f'[{host}]' if ':' in host else host}:{port}"
        self.funded_keys: tuple[bytes, ...] = ()
        self._program = program
        self._process = process
        self._address = (host, port)
        self._output: deque[str] = deque(maxlen=5)  # is shown when it ends by itself
        self._listening = asyncio.create_task(self._listen(), name="output of anvil")

    @property
    def pid(self) -> int:
        """The id of its process."""
        return self._process.pid

    async def until_ready(self, facts: Path) -> None:
        """Return when it answers and has written `facts`. Raises `RemoteError` if it ends, or takes too long."""
        with suppress(TimeoutError):
            async with asyncio.timeout(ANVIL_PACE.starting):
                while self._process.returncode is None:
                    if await self._answers() and (keys := _keys_in(facts)):
                        self.funded_keys = keys
                        return
                    await asyncio.sleep(ANVIL_PACE.looking)
        if self._process.returncode is None:
            raise RemoteError(f"{self._program} does not answer at {self.url} after {ANVIL_PACE.starting:g} s")
        await self.watch()

    async def watch(self) -> NoReturn:
        """Wait until the process ends, and raise `RemoteError` (`node-ended`)."""
        code = await self._process.wait()
        await self._listening
        raise RemoteError(
            f"{self._program.name} ended by itself, {f'with exit code {code}' if code >= 0 else f'by signal {-code}'}",
            hint=" | ".join(self._output) or "it said nothing",
            code="node-ended",
        )

    async def stop(self) -> None:
        """Stop the process and wait for its end."""
        with suppress(ProcessLookupError):
            self._process.terminate()
        try:
            async with asyncio.timeout(ANVIL_PACE.stopping):
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
    """Run anvil for the body, which is cancelled with `RemoteError` when anvil ends by itself; port 0 takes a free one.

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
            command += ["--state", str(state), "--state-interval", str(ANVIL_PACE.saving)]
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
    return partial(prctl, 1, int(signal.SIGTERM))  # PR_SET_PDEATHSIG in linux/prctl.h


def _keys_in(facts: Path) -> tuple[bytes, ...]:
    """The private keys in the file that anvil writes; empty while the file is incomplete."""
    try:
        return tuple(bytes.fromhex(key[2:]) for key in decode_json(facts.read_text())["private_keys"])
    except (OSError, ValueError):
        return ()
