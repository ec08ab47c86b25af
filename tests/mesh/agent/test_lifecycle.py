"""The life of a job: where it may go from where."""

from __future__ import annotations

import pytest

from mesh.agent.ledger import NEXT, UNFINISHED, Phase, WrongPhase, advance

LIABILITY = "0x" + "12" * 20


@pytest.mark.parametrize("phase", [Phase.INCOMING, Phase.READY, Phase.RUNNING])
def test_a_job_that_has_not_ended_can_fail(phase: Phase) -> None:
    assert advance(LIABILITY, phase, Phase.COMPLETE) is Phase.COMPLETE


@pytest.mark.parametrize("phase", UNFINISHED)
def test_the_chain_can_end_a_job_in_any_phase(phase: Phase) -> None:
    assert advance(LIABILITY, phase, Phase.FINALIZED) is Phase.FINALIZED


@pytest.mark.parametrize(
    ("phase", "to"),
    [
        (Phase.INCOMING, Phase.RUNNING),
        (Phase.RUNNING, Phase.READY),
        (Phase.COMPLETE, Phase.RUNNING),
        (Phase.COMPLETE, Phase.COMPLETE),
        (Phase.FINALIZED, Phase.COMPLETE),
    ],
)
def test_a_job_does_not_go_back_or_skip_its_objective(phase: Phase, to: Phase) -> None:
    with pytest.raises(WrongPhase) as caught:
        advance(LIABILITY, phase, to)
    assert (caught.value.code, caught.value.phase, caught.value.liability) == ("wrong-phase", phase, LIABILITY)


def test_every_phase_has_its_next_ones_and_only_the_last_has_none() -> None:
    assert set(NEXT) == set(Phase)
    assert [phase for phase in Phase if not NEXT[phase]] == [Phase.FINALIZED]


def test_a_job_of_another_agent_has_no_phase() -> None:
    error = WrongPhase(LIABILITY, asked="start", phase=None)
    assert (error.code, error.liability, error.asked, error.phase) == ("wrong-phase", LIABILITY, "start", None)
    assert LIABILITY in str(error)
    assert "None" not in str(error)
