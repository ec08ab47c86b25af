"""The life of a job, from the liability that names it to the money that ends it. Pure: no I/O."""

from __future__ import annotations

from enum import StrEnum
from typing import TYPE_CHECKING, Final, Protocol

from mesh.errors import AiraError

if TYPE_CHECKING:
    from schemas import Liability


class Phase(StrEnum):
    """Where a job stands. What is written in the ledger, and where a restarted agent goes on."""

    INCOMING = "incoming"
    """The liability exists and names us; its objective is not here yet."""
    READY = "ready"
    """The objective is here and fit to be played; waits for `start`."""
    RUNNING = "running"
    """The objective is being played and the device recorded."""
    COMPLETE = "complete"
    """The recording is closed and the Result signed; it is sent until the contract has it."""
    FINALIZED = "finalized"
    """The contract has paid, or refunded. Nothing is left to do."""


NEXT: Final = {
    Phase.INCOMING: frozenset({Phase.READY, Phase.COMPLETE, Phase.FINALIZED}),
    Phase.READY: frozenset({Phase.RUNNING, Phase.COMPLETE, Phase.FINALIZED}),
    Phase.RUNNING: frozenset({Phase.READY, Phase.COMPLETE, Phase.FINALIZED}),
    Phase.COMPLETE: frozenset({Phase.FINALIZED}),
    Phase.FINALIZED: frozenset(),
}
"""Where a job may go from each phase. A job that can't be done goes to COMPLETE with success false, which refunds."""

UNFINISHED: Final = (Phase.INCOMING, Phase.READY, Phase.RUNNING, Phase.COMPLETE)


class WrongPhase(AiraError):
    """Something was asked of a job that its phase does not allow; `phase` is where it stands, None if unknown."""

    code = "wrong-phase"

    def __init__(self, liability: str, *, asked: str, phase: Phase | None) -> None:
        where = f"is {phase.value}" if phase else "is not a job of this agent"
        super().__init__(f"can't {asked} {liability}: it {where}")
        self.liability = liability
        self.phase = phase


class PhaseListener(Protocol):
    """Whoever is told that a job has come into a phase (after the ledger knows)."""

    async def __call__(self, phase: Phase, liability: Liability) -> None: ...


def advance(liability: str, phase: Phase, to: Phase) -> Phase:
    """`to`, if a job may go there from `phase`; else raises `WrongPhase`."""
    if to not in NEXT[phase]:
        raise WrongPhase(liability, asked=f"move to {to.value}", phase=phase)
    return to
