"""What a call in the mesh asks for beside its payload, and how it is answered."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import msgspec

from bridges.serial.dialect import Ending
from bridges.serial.errors import REASONS

if TYPE_CHECKING:
    import zenoh

    from bridges.serial.dialect import Ended

LONGEST_PATIENCE: Final = 3600.0


def is_meant_for(query: zenoh.Query, device: str) -> bool:
    """Whether a call is one for this device: its parameter `device` may name another."""
    return query.parameters.get("device") in (None, device)


def patience_of(query: zenoh.Query, otherwise: float) -> float:
    """For how many seconds who calls wants to wait: the parameter `timeout`."""
    try:
        seconds = float(query.parameters.get("timeout") or otherwise)
    except ValueError:
        return otherwise
    return min(max(seconds, 0.0), LONGEST_PATIENCE)


def reply(query: zenoh.Query, ended: Ended) -> None:
    """Say how a call ended."""
    if ended.ending is Ending.FAILED:
        refuse(query, ended.reason, ended.detail)
        return
    encoding = ended.type.zenoh_encoding if ended.type is not None else ""
    with query:
        query.reply(str(query.key_expr), ended.payload, encoding=encoding, attachment=ended.ending.value)


def refuse(query: zenoh.Query, reason: str, detail: str) -> None:
    """Say that a call is not done, or that nobody knows; `reason` is one of `REASONS`."""
    assert reason in REASONS
    with query:
        query.reply_err(msgspec.json.encode({"reason": reason, "detail": detail}), encoding="application/json")
