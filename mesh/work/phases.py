"""The phases of a job, and which may follow which. The ledger keeps them."""

from __future__ import annotations

from enum import StrEnum
from typing import Final

from mesh.errors import AiraError


class Phase(StrEnum):
    """Where a job is. The ledger keeps it, and a restarted agent continues from it."""

    INCOMING = "incoming"
    """The liability exists and names this agent; its objective has not been fetched yet."""
    READY = "ready"
    """The objective was fetched and can be played; the job waits for `start`."""
    RUNNING = "running"
    """The objective is being played and the device recorded."""
    COMPLETE = "complete"
    """The recording is closed and the Result signed; it is sent until the contract has it."""
    FINALIZED = "finalized"
    """The contract has paid or refunded. Nothing is left to do."""


NEXT: Final = {
    Phase.INCOMING: frozenset({Phase.READY, Phase.COMPLETE, Phase.FINALIZED}),
    Phase.READY: frozenset({Phase.RUNNING, Phase.COMPLETE, Phase.FINALIZED}),
    Phase.RUNNING: frozenset({Phase.COMPLETE, Phase.FINALIZED}),
    Phase.COMPLETE: frozenset({Phase.FINALIZED}),
    Phase.FINALIZED: frozenset(),
}
"""The phases that may follow each phase. A job that fails moves to COMPLETE without success, which refunds."""

UNFINISHED: Final = (Phase.INCOMING, Phase.READY, Phase.RUNNING, Phase.COMPLETE)

TO_BE_DONE: Final = (Phase.INCOMING, Phase.READY, Phase.RUNNING)
"""Phases of a job whose work is not done yet."""

STARTABLE: Final = (Phase.READY, Phase.RUNNING)
"""Phases in which a job's playback may begin, continue or be restarted."""


class WrongPhase(AiraError, code="wrong-phase"):
    """The job's phase does not allow the operation. `phase` is its phase, None if the agent has no such job."""

    def __init__(self, liability: str, *, asked: str, phase: Phase | None) -> None:
        where = f"is {phase.value}" if phase else "is not a job of this agent"
        super().__init__(f"can't {asked} {liability}: it {where}")
        self.liability = liability
        self.asked = asked
        self.phase = phase


def advance(liability: str, phase: Phase, to: Phase) -> Phase:
    """`to`, if a job may move there from `phase`. Raises `WrongPhase` otherwise."""
    if to not in NEXT[phase]:
        raise WrongPhase(liability, asked=f"move to {to.value}", phase=phase)
    return to
