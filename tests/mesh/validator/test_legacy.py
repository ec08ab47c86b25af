"""Findings on results that the legacy software recorded."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import pytest

from mesh.recording import convert, pack
from mesh.recording.objective import Played
from mesh.recording.ros import RosTypes
from mesh.validator.verification import Claim, JobFiles, Verdict, verify
from schemas import cid_of_file, parse_address

if TYPE_CHECKING:
    from pathlib import Path

JOB: Final = "0x" + "AB" * 20
OTHER: Final = "0x" + "12" * 20
DUE: Final = [("/blink", "red"), ("/blink", "blue"), ("/move", "on")]


def bag(path: Path, messages: list[tuple[str, str]]) -> Path:
    """A bag with these texts on these topics."""
    packed, types = path.with_suffix(".mcap"), RosTypes("jazzy")
    texts = [(topic, types.message("std_msgs/String", data=text)) for topic, text in messages]
    pack([Played(topic, one.data, at, at, 0, one.type) for at, (topic, one) in enumerate(texts, 1)], packed)
    convert(packed, path, to="bag")
    return path


def judge(folder: Path, recorded: list[tuple[str, str]], *, bags: bool = True) -> Verdict:
    """Verify a job with the objective `DUE` whose result has these messages."""
    objective, result = bag(folder / "objective.bag", DUE), bag(folder / "result.bag", recorded)
    claim = Claim(
        liability=parse_address(JOB),
        promisor=parse_address(OTHER),
        objective=cid_of_file(objective),
        result=cid_of_file(result),
        success=True,
        finalized=True,
    )
    return verify(claim, JobFiles(objective=objective, result=result), bags=bags)


def below(messages: list[tuple[str, str]], liability: str = JOB) -> list[tuple[str, str]]:
    """These messages as the legacy player publishes them."""
    return [(f"/liability/eth_{liability}{topic}", text) for topic, text in messages]


def failed(verdict: Verdict) -> list[str]:
    """The checks that failed."""
    return [finding.name for finding in verdict.findings if finding.holds is False]


@pytest.mark.parametrize("liability", [JOB, JOB.lower()])
def test_a_genuine_bag_passes(tmp_path: Path, liability: str) -> None:
    said = [DUE[2], ("/blink", "own"), *DUE[:2]]
    verdict = judge(tmp_path, [*below(said, liability), ("/rosout", "x")])
    assert failed(verdict) == []
    assert {finding.name for finding in verdict.findings if finding.holds} >= {"liability", "played", "result-file"}
    closed = verdict.of("closed")
    assert closed is not None
    assert "does not apply" in closed.detail


@pytest.mark.parametrize(
    ("recorded", "fails"),
    [
        (below(DUE[:2]), ["played"]),
        (below(DUE[1:]), ["played"]),
        (below([DUE[1], DUE[0], DUE[2]]), ["played"]),
        ([*below(DUE[:2]), DUE[2]], ["played"]),
        (below(DUE, OTHER), ["liability", "played"]),
        (DUE, ["liability", "played"]),
    ],
)
def test_a_bag_without_a_played_message_fails(
    tmp_path: Path, recorded: list[tuple[str, str]], fails: list[str]
) -> None:
    assert failed(judge(tmp_path, recorded)) == fails


def test_a_bag_is_refused_where_only_ours_count(tmp_path: Path) -> None:
    assert "closed" in failed(judge(tmp_path, below(DUE), bags=False))
