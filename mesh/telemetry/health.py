"""The health of a role: the state of each of its parts, as `aira status` shows it, for `/health`. Pure."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import msgspec

from mesh.telemetry.events import without_secrets
from mesh.telemetry.families import Family, by_label
from schemas.status import ALIVE, OFF

if TYPE_CHECKING:
    from collections.abc import Mapping

STARTING: Final = "still waits"
"""The state of the start of a role, until it is over."""


class Health(msgspec.Struct, frozen=True):
    """How a role is. `ok` if each of its `parts` is `ALIVE`, or `OFF` by its settings."""

    ok: bool
    parts: dict[str, str]

    @classmethod
    def of(cls, parts: Mapping[str, str]) -> Health:
        """The health of who has these parts: name → state.

        What opens doors in the addresses that a state names is left out: whoever reaches the page reads it.
        """
        told = {part: without_secrets(state) for part, state in parts.items()}
        return cls(all(is_well(state) for state in parts.values()), told)

    def encode(self) -> bytes:
        """As `/health` answers it: one JSON object."""
        return msgspec.json.encode(self)

    @classmethod
    def decode(cls, answer: bytes) -> Health:
        """What an answer of `/health` says. Raises `msgspec.MsgspecError`."""
        return msgspec.json.decode(answer, type=cls)


def is_well(state: str) -> bool:
    """Whether a part in that state needs nobody's attention."""
    return state in (ALIVE, OFF)


def up(parts: Mapping[str, str]) -> Family:
    """The same as a figure: for each part whether it is well, so that an alert can be raised by it."""
    values = {part: float(is_well(state)) for part, state in parts.items()}
    return by_label(
        "aira_part_up", "gauge", "1 for a part of this role that does what it is for, 0 otherwise", "part", values
    )
