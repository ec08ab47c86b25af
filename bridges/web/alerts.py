"""What an operator should look at, by what agents, providers and bridges say of themselves."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

from mesh.telemetry.health import is_healthy
from schemas.status import BridgeStatus

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from mesh.watching import RoleStatus

BEHIND: Final = 60
"""Blocks that somebody may be behind the chain."""
FULL: Final = 0.95
"""The part of its quota that a store may use."""
LONGEST: Final = 200
"""Characters of a detail, which a stranger may have written."""
ALERTS: Final = 256


def alerts_of(found: Mapping[str, RoleStatus | None], head: int) -> list[dict[str, Any]]:
    """The alerts about these addresses, at most `ALERTS`; `head` is the last block that the page knows."""
    alerts = [
        {"agent": address, "code": code, "detail": detail[:LONGEST]}
        for address, status in found.items()
        for code, detail in _alerts(status, head)
    ]
    return alerts[:ALERTS]


def waiting_parts(status: RoleStatus) -> list[str]:
    """The parts of an agent, a provider or a bridge that do not work now, each with its state."""
    if isinstance(status, BridgeStatus):
        return [] if status.state in ("connected", "alone") else [f"bridge: {status.state}"]
    return [f"{part}: {state}" for part, state in status.parts.items() if not is_healthy(state)]


def _alerts(status: RoleStatus | None, head: int) -> Iterator[tuple[str, str]]:
    if status is None:
        yield "silent", ""
        return
    for waiting in waiting_parts(status):
        yield "part-waits", waiting
    if isinstance(status, BridgeStatus):
        return
    if status.head + BEHIND < head:
        yield "behind", f"{head - status.head} blocks"
    if status.work is not None:
        store = status.work.store
        if store.quota and store.bytes > FULL * store.quota:
            yield "store-full", f"{store.bytes} of {store.quota} bytes"
    if dropped := sum(sum(senders.values()) for senders in status.heaviest.values()):
        yield "drops", f"{dropped} in the last minute"
