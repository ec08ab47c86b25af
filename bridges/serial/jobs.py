"""Which job of an agent goes on, as far as its edge agent can see."""

from __future__ import annotations

import logging

from mesh.errors import InvalidKey
from schemas.keys import EventKey, parse_key

log = logging.getLogger(__name__)


class Jobs:
    """The agent's jobs that are ready and not complete, in their order; the first of them is the one that goes on."""

    def __init__(self) -> None:
        self._open: list[str] = []

    @property
    def current(self) -> str:
        """The liability (address) that the device works for now; empty for none."""
        return self._open[0] if self._open else ""

    def begin(self, liability: str) -> None:
        """A command says for which job it is: that one goes on now."""
        if liability in self._open:
            self._open.remove(liability)
        self._open.insert(0, liability)

    def take_event(self, key: str) -> None:
        """What the agent tells of its jobs, by the key of the event."""
        try:
            event = parse_key(key)
        except InvalidKey as error:
            log.info("%s", error)
            return
        if not isinstance(event, EventKey):
            return
        if event.event == "ready" and event.liability not in self._open:
            self._open.append(event.liability)
        elif event.event in ("complete", "finalized") and event.liability in self._open:
            self._open.remove(event.liability)
