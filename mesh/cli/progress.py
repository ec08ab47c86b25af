"""How far long work has come, for people at a terminal; nothing where nobody watches."""

from __future__ import annotations

import sys
import time
from contextlib import contextmanager
from typing import TYPE_CHECKING, Final

import click

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

BEAT: Final = 0.1
"""Seconds between two pictures of the bar."""


@contextmanager
def progress(label: str) -> Iterator[Callable[[int, int | None], None]]:
    """A function to be told how much is done, and of how much (None: unknown), which shows a bar on stderr.

    Called from any one thread. Shows nothing where stderr is no terminal.
    """
    if not sys.stderr.isatty():
        yield lambda done, total: None
        return
    with click.progressbar(length=1, label=label, file=sys.stderr, show_pos=False) as bar:
        seen, shown = 0, 0.0

        def tell(done: int, total: int | None) -> None:
            nonlocal seen, shown
            if total and (done >= total or time.monotonic() >= shown + BEAT):
                bar.length = total
                bar.update(max(0, done - seen))
                seen, shown = max(seen, done), time.monotonic()

        yield tell
