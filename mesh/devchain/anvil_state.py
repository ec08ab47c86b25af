"""The file in which anvil keeps a chain, protected against crashes.

Anvil rewrites the file in place again and again; a process that is killed while it writes leaves half a chain. So a
copy of the last whole state is kept beside the file, and used instead of a damaged one.
"""

from __future__ import annotations

import asyncio
import json
import logging
import os
from typing import TYPE_CHECKING, Final, NoReturn

from mesh.devchain.errors import InvalidChainState
from mesh.errors import ConfigurationError
from mesh.log_context import log_event

if TYPE_CHECKING:
    from pathlib import Path

log = logging.getLogger(__name__)

STATE_SECONDS: Final = 2
"""Seconds between two saves of the state: a power cut costs at most two of these."""


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
            raise InvalidChainState(state)
        _replace(state, whole)
    except OSError as error:
        raise ConfigurationError(f"can't keep the chain in {state}: {error.strerror}") from None
    log.warning(
        "%s was cut off: using the last complete copy",
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


def write_state(state: Path, content: bytes) -> None:
    """Write a whole chain to `state` in one step, and its copy. Raises `ConfigurationError` when it can't."""
    try:
        _replace(state_copy(state), content)
        _replace(state, content)
    except OSError as error:
        raise ConfigurationError(f"can't keep the chain in {state}: {error.strerror}") from None


def state_copy(state: Path) -> Path:
    """The file with the last whole state."""
    return state.with_name(f"{state.name}.kept")


def _copy_state(state: Path, seen: int) -> int:
    """Copy a whole state, unless it was `seen`; the time of its last change (nanoseconds)."""
    written = state.stat().st_mtime_ns if state.exists() else seen
    if written != seen and _is_chain(content := state.read_bytes()):
        _replace(state_copy(state), content)
    return written


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
