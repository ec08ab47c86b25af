"""Somebody in the mesh who takes note of all that is said."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Any, Final

if TYPE_CHECKING:
    import zenoh

SOON: Final = 30.0
"""Seconds in which what was said arrives."""


class Listener:
    """Hears everything from now on: key, payload, encoding and when, in the order of arrival."""

    def __init__(self, session: zenoh.Session) -> None:
        self._heard: list[tuple[str, bytes, str, float]] = []
        self._subscriber: Any = session.declare_subscriber("**", self._hear)

    def _hear(self, sample: zenoh.Sample) -> None:
        said = str(sample.key_expr), sample.payload.to_bytes(), str(sample.encoding), time.monotonic()
        self._heard.append(said)

    def heard(self, count: int) -> list[tuple[str, bytes, str, float]]:
        """What was said, once it is so much."""
        deadline = time.monotonic() + SOON
        while len(self._heard) < count and time.monotonic() < deadline:
            time.sleep(0.01)
        return list(self._heard)

    def keys(self, count: int) -> list[str]:
        """The keys of what was said, once it is so much."""
        return [key for key, *_ in self.heard(count)]
