"""A chain that anvil keeps in a file. It writes the file in place, again and again: who is killed at such a moment
leaves half a chain. So the last whole one is kept beside it, and taken from there. A chain that was killed while its
contracts were made holds half a market; it has nothing that anybody could miss, and is begun anew."""

from __future__ import annotations

import asyncio
import json
import logging
import os
from contextlib import contextmanager
from typing import TYPE_CHECKING, Final, NoReturn

from mesh.errors import ConfigurationError

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

log = logging.getLogger(__name__)

STATE_SECONDS: Final = 2
"""Between two savings of the state: what a power cut costs is at most two of these."""
MADE: Final = "the contracts are made"


def prepare_state(state: Path) -> None:
    """Have a file that anvil can begin with, or none: half a chain is replaced by the last whole one.

    Raises `ConfigurationError` for a file that holds no chain, where none was kept either, and a folder that can't be
    written to.
    """
    try:
        state.parent.mkdir(parents=True, exist_ok=True)
        if being_founded(state).exists():
            log.warning("%s was cut off before its contracts were made and saved: the chain begins anew", state)
            for file in (state, kept(state), being_founded(state)):
                file.unlink(missing_ok=True)
        if not state.exists() or _is_chain(state.read_bytes()):
            return
        whole = kept(state).read_bytes() if kept(state).exists() else b""
        if not _is_chain(whole):
            raise ConfigurationError(f"{state} holds no chain of anvil", hint="name another file, or remove it")
        _replace(state, whole)
    except OSError as error:
        raise ConfigurationError(f"can't keep the chain in {state}: {error.strerror}") from None
    log.warning("%s was cut off while it was written: the chain goes on from the last whole one", state)


async def keep_state(state: Path) -> NoReturn:
    """Keep a copy of each whole state that anvil writes, until cancelled. Raises `ConfigurationError` when it can't."""
    seen = 0
    while True:
        await asyncio.sleep(STATE_SECONDS)
        try:
            seen = await asyncio.to_thread(_keep, state, seen)
        except OSError as error:
            raise ConfigurationError(f"can't keep the chain in {kept(state)}: {error.strerror}") from None


@contextmanager
def founding(state: Path | None) -> Iterator[None]:
    """While the body makes the contracts, and until they are saved, a chain that ends is begun anew.

    Raises `ConfigurationError` when that can't be written down.
    """
    _mark(state, "the contracts are being made\n")
    yield
    _mark(state, f"{MADE}, and not saved yet\n")


def settle_state(state: Path) -> None:
    """After anvil's end, which wrote the state once more: contracts that are in it are not made again."""
    if state.exists():
        _be_founded(being_founded(state), saved=state.stat().st_mtime_ns)


def kept(state: Path) -> Path:
    """Where the last whole state is."""
    return state.with_name(f"{state.name}.kept")


def being_founded(state: Path) -> Path:
    """The file that is there until a chain with all its contracts is saved."""
    return state.with_name(f"{state.name}.founding")


def _keep(state: Path, seen: int) -> int:
    """Copy a state that is whole, unless it was `seen`: the time of its last change, which is returned."""
    written = state.stat().st_mtime_ns if state.exists() else seen
    if written != seen and _is_chain(content := state.read_bytes()):
        _replace(kept(state), content)
        _be_founded(being_founded(state), saved=written)
    return written


def _mark(state: Path | None, words: str) -> None:
    if state is not None:
        try:
            being_founded(state).write_text(words)
        except OSError as error:
            raise ConfigurationError(f"can't keep the chain in {state}: {error.strerror}") from None


def _be_founded(mark: Path, *, saved: int) -> None:
    """Remove the mark once the contracts are made and in what was `saved` (nanoseconds since the epoch)."""
    if mark.exists() and mark.stat().st_mtime_ns < saved and mark.read_text().startswith(MADE):
        mark.unlink()


def _replace(path: Path, content: bytes) -> None:
    """Write a file in one step: whoever reads it finds the old one or the new one."""
    fresh = path.with_name(f"{path.name}.new")
    with fresh.open("wb") as file:
        file.write(content)
        file.flush()
        os.fsync(file.fileno())
    fresh.replace(path)


def _is_chain(content: bytes) -> bool:
    """Whether this is a state of anvil's, as a whole."""
    try:
        found = json.loads(content)
    except ValueError:
        return False
    return isinstance(found, dict) and "accounts" in found
