"""The health of a role: the state of each of its parts, for `/health` and `aira health`. Pure."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import msgspec

from mesh.errors import ConfigurationError
from mesh.telemetry.events import without_secrets
from mesh.telemetry.metrics import MetricFamily, by_label
from schemas.status import ALIVE, OFF

if TYPE_CHECKING:
    from collections.abc import Mapping

STARTING: Final = "still waits"
"""The state of a role's part `start` until the role has started."""


class InvalidListenAddress(ConfigurationError, code="invalid-listen-address"):
    """The setting `metrics_listen` is not HOST:PORT."""


class Health(msgspec.Struct, frozen=True):
    """The state of each part of a role. `ok` if every part is `ALIVE`, or `OFF` by its settings."""

    ok: bool
    parts: dict[str, str]

    @classmethod
    def of(cls, parts: Mapping[str, str]) -> Health:
        """The health of a role with these parts (name → state).

        Secrets in URLs that a state quotes are removed, because anyone who reaches the page can read it.
        """
        shown = {part: without_secrets(state) for part, state in parts.items()}
        return cls(all(is_healthy(state) for state in parts.values()), shown)

    def encode(self) -> bytes:
        """The JSON object that `/health` answers."""
        return msgspec.json.encode(self)

    @classmethod
    def decode(cls, answer: bytes) -> Health:
        """Read an answer of `/health`. Raises `msgspec.MsgspecError`."""
        return msgspec.json.decode(answer, type=cls)


def is_healthy(state: str) -> bool:
    """Whether a part in this state needs no attention."""
    return state in (ALIVE, OFF)


def health_metrics(parts: Mapping[str, str]) -> MetricFamily:
    """Health as a metric, so that alerts can use it: 1 for each part that works, 0 for each that does not."""
    values = {part: float(is_healthy(state)) for part, state in parts.items()}
    return by_label(
        "aira_part_up", "gauge", "1 for a part of this role that does what it is for, 0 otherwise", "part", values
    )


def listen_address(listen: str) -> tuple[str, int]:
    """Parse HOST:PORT; an IPv6 address is in brackets. Raises `InvalidListenAddress`."""
    host, _, port = listen.rpartition(":")
    bare = host.removeprefix("[").removesuffix("]")
    if not bare or (":" in bare) == (bare == host) or not (port.isascii() and port.isdigit()) or int(port) > 65_535:
        raise InvalidListenAddress(
            f"metrics_listen is {listen!r}, not HOST:PORT",
            hint="give --metrics-listen 127.0.0.1:9464, or 0.0.0.0:9464 for other machines; empty serves no metrics",
        )
    return bare, int(port)
