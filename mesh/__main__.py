"""`aira`, also as `python -m mesh`: the command line, which Ctrl-C ends quietly even while it is being loaded."""

from __future__ import annotations

import os
import signal
from typing import TYPE_CHECKING, NoReturn

if TYPE_CHECKING:
    from types import FrameType


def main() -> None:
    """Load the command line and run it."""
    # Until the command listens to signals itself there is nothing to tidy up, but an interrupted import may print a
    # traceback, swallow the interrupt, or make Python exit with another code.
    signal.signal(signal.SIGINT, _leave)
    from mesh.base.terminal import accept_all_characters
    from mesh.cli import main as command_line

    accept_all_characters()
    command_line(prog_name="aira")


def _leave(number: int, frame: FrameType | None) -> NoReturn:
    os._exit(130)  # `mesh.role.running.INTERRUPTED`, which may not be loaded yet


if __name__ == "__main__":
    main()
