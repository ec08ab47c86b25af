"""Whoever reads what a command prints may leave; a command that waits for news has to notice it meanwhile."""

from __future__ import annotations

import asyncio
import errno
import io
import os
import select
import sys
from typing import Final

LOOK: Final = 0.5
"""Seconds between two looks."""


async def until_unread() -> None:
    """Raise `BrokenPipeError`, which ends the program without a word, when nobody reads stdout any more.

    Does nothing where stdout is no file of the system's.
    """
    try:
        number = sys.stdout.fileno()
    except (io.UnsupportedOperation, AttributeError, ValueError):
        return
    poll = select.poll()
    poll.register(number, 0)
    while True:
        if any(event & select.POLLERR for _, event in poll.poll(0)):
            raise BrokenPipeError(errno.EPIPE, os.strerror(errno.EPIPE))
        await asyncio.sleep(LOOK)
