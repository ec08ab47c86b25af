"""A program that is started again when its files change, beside a market for development."""

from __future__ import annotations

import asyncio
import os
import sys
from contextlib import suppress
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

INTERVAL: Final = 0.3
"""Seconds between two looks at the files."""
PATIENCE: Final = 10.0
"""Seconds for a program to end by itself."""
LONGEST_LINE: Final = 64 * 1024
"""Bytes of a line; what is longer is shown in parts."""


async def run_watched(path: Path, variables: Mapping[str, str]) -> None:
    """Run a Python program until cancelled, and start it again when a `.py` or `.json` file of its folder changes.

    `variables` are added to its environment. What it prints goes to stderr, each line after the program's name. One
    that has ended starts again with the next change.
    """
    while True:
        before = _times(path)
        process = await asyncio.create_subprocess_exec(
            sys.executable,
            "-u",
            path,
            env={**os.environ, **variables},
            stdin=asyncio.subprocess.DEVNULL,
            stdout=asyncio.subprocess.PIPE,
            stderr=asyncio.subprocess.STDOUT,
        )
        assert process.stdout is not None
        showing = asyncio.create_task(_show(path.stem, process.stdout), name=f"output of {path.name}")
        ending = asyncio.create_task(process.wait(), name=f"end of {path.name}")
        try:
            has_ended = False
            while _times(path) == before:
                if ending.done() and not has_ended:
                    has_ended = True
                    await showing
                    _say(path.stem, f"ended with exit code {process.returncode}; starts again when you change a file")
                await asyncio.sleep(INTERVAL)
            _say(path.stem, "a file has changed, so it starts again")
        finally:
            await _end(process)
            await asyncio.gather(showing, ending)


def _times(path: Path) -> dict[str, int]:
    """When the program and the files beside it were changed, in nanoseconds of Unix time."""
    found = {}
    for file in (*path.parent.glob("*.py"), *path.parent.glob("*.json")):
        with suppress(OSError):  # an editor replaces it just now
            found[file.name] = file.stat().st_mtime_ns
    return found


async def _end(process: asyncio.subprocess.Process) -> None:
    """End a process: in good order, or after `PATIENCE` at once."""
    with suppress(ProcessLookupError):
        process.terminate()
        try:
            async with asyncio.timeout(PATIENCE):
                await process.wait()
        except TimeoutError:
            process.kill()


async def _show(name: str, output: asyncio.StreamReader) -> None:
    kept = b""
    while read := await output.read(LONGEST_LINE):
        *lines, kept = (kept + read).split(b"\n")
        for line in lines:
            _say(name, line.decode(errors="replace"))
        if len(kept) > LONGEST_LINE:
            _say(name, kept.decode(errors="replace"))
            kept = b""
    if kept:
        _say(name, kept.decode(errors="replace"))


def _say(name: str, line: str) -> None:
    print(f"{name} | {line}", file=sys.stderr, flush=True)
