"""A subscriber to everything in the mesh."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Any, Final

if TYPE_CHECKING:
    import zenoh

SOON: Final = 60.0
"""Seconds in which messages arrive."""


class Listener:
    """Records every sample from now on: key, payload, encoding and time, in the order of arrival."""

    def __init__(self, session: zenoh.Session) -> None:
        self._heard: list[tuple[str, bytes, str, float]] = []
        self._subscriber: Any = session.declare_subscriber("**", self._hear)

    def _hear(self, sample: zenoh.Sample) -> None:
        said = str(sample.key_expr), sample.payload.to_bytes(), str(sample.encoding), time.monotonic()
        self._heard.append(said)

    def heard(self, count: int) -> list[tuple[str, bytes, str, float]]:
        """The samples, once there are `count`."""
        deadline = time.monotonic() + SOON
        while len(self._heard) < count and time.monotonic() < deadline:
            time.sleep(0.01)
        return list(self._heard)

    def keys(self, count: int) -> list[str]:
        """The keys of the samples, once there are `count`."""
        return [key for key, *_ in self.heard(count)]
