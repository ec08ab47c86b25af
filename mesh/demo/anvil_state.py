"""A chain that anvil keeps in a file. It writes the file in place, again and again: who is killed at such a moment
leaves half a chain. So the last whole one is kept beside it, and taken from there."""

from __future__ import annotations

import asyncio
import json
import logging
import os
from typing import TYPE_CHECKING, Final, NoReturn

from mesh.errors import ConfigurationError

if TYPE_CHECKING:
    from pathlib import Path

log = logging.getLogger(__name__)

STATE_SECONDS: Final = 2
"""Between two savings of the state: what a power cut costs is at most two of these."""


def prepare_state(state: Path) -> None:
    """Have a file that anvil can begin with, or none: half a chain is replaced by the last whole one.

    Raises `ConfigurationError` for a file that holds no chain, where none was kept either, and a folder that can't be
    written to.
    """
    try:
        state.parent.mkdir(parents=True, exist_ok=True)
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


def kept(state: Path) -> Path:
    """Where the last whole state is."""
    return state.with_name(f"{state.name}.kept")


def _keep(state: Path, seen: int) -> int:
    """Copy a state that is whole, unless it was `seen`: the time of its last change, which is returned."""
    written = state.stat().st_mtime_ns if state.exists() else seen
    if written != seen and _is_chain(content := state.read_bytes()):
        _replace(kept(state), content)
    return written


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
