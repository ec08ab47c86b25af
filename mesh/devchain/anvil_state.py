"""The file in which anvil keeps a chain, protected against crashes.

Anvil rewrites the file in place again and again; a process that is killed while it writes leaves half a chain. So a
copy of the last whole state is kept beside the file, and used instead of a damaged one. A chain that was killed while
its contracts were deployed holds half a market and nothing that anybody could miss: it is started again from nothing.
"""

from __future__ import annotations

import asyncio
import json
import logging
import os
from contextlib import contextmanager
from typing import TYPE_CHECKING, Final, NoReturn

from mesh.devchain.errors import InvalidChainState
from mesh.errors import ConfigurationError
from mesh.log_context import log_event

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

log = logging.getLogger(__name__)

STATE_SECONDS: Final = 2
"""Seconds between two saves of the state: a power cut costs at most two of these."""
DEPLOYED: Final = "the contracts are made"


def prepare_state(state: Path) -> None:
    """Make sure that `state` is a file that anvil can load, or absent; half a chain is replaced by the last whole one.

    Raises `ConfigurationError` for a file that is no chain and has no copy, and a folder that can't be written to.
    """
    try:
        state.parent.mkdir(parents=True, exist_ok=True)
        if deployment_mark(state).exists():
            log.warning(
                "%s was not saved with all its contracts: starting a new chain",
                state,
                extra=log_event("chain-state-discarded", path=state),
            )
            for file in (state, state_copy(state), deployment_mark(state)):
                file.unlink(missing_ok=True)
        if not state.exists() or _is_chain(state.read_bytes()):
            return
        whole = state_copy(state).read_bytes() if state_copy(state).exists() else b""
        if not _is_chain(whole):
            raise InvalidChainState(state)
        _replace(state, whole)
    except OSError as error:
        raise ConfigurationError(f"can't keep the chain in {state}: {error.strerror}") from None
    log.warning(
        "%s was not written to its end: using the last whole copy",
        state,
        extra=log_event("chain-state-restored", path=state),
    )


async def copy_states(state: Path) -> NoReturn:
    """Copy each whole state that anvil saves, until cancelled. Raises `ConfigurationError` when it can't."""
    seen = 0
    while True:
        await asyncio.sleep(STATE_SECONDS)
        try:
            seen = await asyncio.to_thread(_copy_state, state, seen)
        except OSError as error:
            raise ConfigurationError(f"can't keep the chain in {state_copy(state)}: {error.strerror}") from None


@contextmanager
def deploying(state: Path | None) -> Iterator[None]:
    """Mark the chain as incomplete while the body deploys the contracts, and until they are saved.

    Raises `ConfigurationError` when the mark can't be written.
    """
    _mark(state, "the contracts are being made\n")
    yield
    _mark(state, f"{DEPLOYED}, and not saved yet\n")


def settle_state(state: Path) -> None:
    """Remove the mark after anvil's end, which saved the state once more."""
    if state.exists():
        _unmark(deployment_mark(state), saved=state.stat().st_mtime_ns)


def state_copy(state: Path) -> Path:
    """The file with the last whole state."""
    return state.with_name(f"{state.name}.kept")


def deployment_mark(state: Path) -> Path:
    """The file that exists until a chain is saved with all its contracts."""
    return state.with_name(f"{state.name}.founding")


def _copy_state(state: Path, seen: int) -> int:
    """Copy a whole state, unless it was `seen`; the time of its last change (nanoseconds)."""
    written = state.stat().st_mtime_ns if state.exists() else seen
    if written != seen and _is_chain(content := state.read_bytes()):
        _replace(state_copy(state), content)
        _unmark(deployment_mark(state), saved=written)
    return written


def _mark(state: Path | None, words: str) -> None:
    if state is not None:
        try:
            deployment_mark(state).write_text(words)
        except OSError as error:
            raise ConfigurationError(f"can't keep the chain in {state}: {error.strerror}") from None


def _unmark(mark: Path, *, saved: int) -> None:
    """Remove the mark if the contracts were deployed before the state was `saved` (nanoseconds since the epoch)."""
    if mark.exists() and mark.stat().st_mtime_ns < saved and mark.read_text().startswith(DEPLOYED):
        mark.unlink()


def _replace(path: Path, content: bytes) -> None:
    """Write a file in one step: a reader finds the old one or the new one."""
    fresh = path.with_name(f"{path.name}.new")
    with fresh.open("wb") as file:
        file.write(content)
        file.flush()
        os.fsync(file.fileno())
    fresh.replace(path)


def _is_chain(content: bytes) -> bool:
    """Whether this is a whole state of anvil's."""
    try:
        found = json.loads(content)
    except ValueError:
        return False
    return isinstance(found, dict) and "accounts" in found
