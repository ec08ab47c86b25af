"""What a server says when it begins: words on stdout for people and scripts, an event of the log for programs."""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING

from mesh.telemetry.context import log_event
from mesh.telemetry.logs import own_log

if TYPE_CHECKING:
    from logging import Logger


def announce(log: Logger, words: str, **known: object) -> None:
    """Say what a server has become, at every level of the log; an event has all lines of it as one.

    Those of `known` that are text are for programs.
    """
    from mesh.cli.printing import say

    own = own_log()
    if own is None or not own.writes_json:
        say(words)
    if own is not None:
        texts = {name: value for name, value in known.items() if isinstance(value, str)}
        line = "; ".join(" ".join(part.split()) for part in words.splitlines())
        record = log.makeRecord(
            log.name, logging.INFO, __file__, 0, "%s", (line,), None, extra=log_event("unnamed", **texts)
        )
        record.is_said = True
        log.handle(record)
