"""The whole of it: two files, a claim, and what of them holds."""

from __future__ import annotations

from typing import TYPE_CHECKING

import msgspec

from mesh.evidence.about import check_about
from mesh.evidence.claims import check_end, check_signature, supplemented
from mesh.evidence.completeness import Numbering, check_completeness
from mesh.evidence.findings import Finding, Verdict
from mesh.evidence.playing import Sign, check_played, sign_of
from mesh.recording import ABOUT, GENEROUS, RECOVERED, RecordingError, open_objective
from schemas import cid_of_file

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path
    from typing import TypeAlias

    from mesh.content import Progress
    from mesh.evidence.claims import Claim
    from mesh.recording import Objective

    Opener: TypeAlias = Callable[[Path], Objective]


def verify(
    claim: Claim,
    *,
    objective: Path,
    result: Path,
    message: bytes | None = None,
    objective_cid: str = "",
    result_cid: str = "",
    progress: Progress | None = None,
) -> Verdict:
    """Look at all that can be looked at: the files behind the two CIDs, the signature, the recording.

    `message` is the Result as it travelled, if it is at hand. The CIDs are given for files that were fetched, and so
    checked, by them: one that was made with other settings than ours can't be worked out anew. `progress` is told how
    many bytes of both files are read, of how many. Use a thread. Raises `OSError` when one can't be read at all.
    """
    cids = objective_cid or cid_of_file(objective), result_cid or cid_of_file(result)
    opened = _opener(result, objective, progress)
    return Verdict(tuple(_findings(claim, objective, result, message, *cids, opened)))


def _opener(first: Path, second: Path, progress: Progress | None) -> Opener:
    """What opens one of two files that are read one after the other; `progress` is told of both together."""
    sizes = first.stat().st_size, second.stat().st_size
    before = iter((0, sizes[0]))

    def opened(path: Path) -> Objective:
        start = next(before)
        tell = None if progress is None else lambda done, _: progress(start + done, sum(sizes))
        return open_objective(path, GENEROUS, progress=tell)

    return opened


def _findings(
    claim: Claim,
    objective: Path,
    result: Path,
    message: bytes | None,
    objective_cid: str,
    result_cid: str,
    opened: Opener,
) -> Iterator[Finding]:
    yield check_end(claim)
    yield check_signature(claim, message, recording=result_cid)
    claim = supplemented(claim, message)
    yield _file("result-file", "result", result_cid, claim.result)
    yield _file("objective-file", "objective", objective_cid, claim.objective)
    if not claim.objective:
        # Whoever has no contract at hand still wants to know that the two files belong together.
        claim = msgspec.structs.replace(claim, objective=objective_cid)
    try:
        recording = opened(result)
    except RecordingError as error:
        yield Finding("readable", False, f"the recording is not: {error.why}")
        return
    yield from _recording(claim, recording, objective, opened)


def _recording(claim: Claim, recording: Objective, path: Path, opened: Opener) -> Iterator[Finding]:
    numbering, played, seams = Numbering(), list[Sign](), list[int]()
    breaks = _numbers(recording.metadata.get(RECOVERED, {}).get("seams", ""))
    for number, written in enumerate(recording.in_file_order()):
        if number in breaks:
            seams.append(len(played))
        numbering.take(written)
        if written.message.role == "objective":
            played.append(sign_of(written.message))
    yield from check_completeness(recording, numbering)
    yield from check_about(claim, recording.metadata)
    try:
        objective = opened(path)
    except RecordingError as error:
        why = f"the objective is no recording ({error.why})"
        if played:
            yield Finding("played", False, f"messages were played, but {why}")
        else:
            yield Finding("played", None, f"nothing was played: {why}")
        return
    yield _played(claim, recording, objective, played, seams)


def _played(claim: Claim, recording: Objective, objective: Objective, played: list[Sign], seams: list[int]) -> Finding:
    chosen = {name for name in recording.metadata.get(ABOUT, {}).get("topics", "").split(",") if name}
    due = [sign_of(message) for message in objective.messages() if not chosen or message.topic in chosen]
    finding = check_played(due, played, seams=seams, complete=claim.success is True)
    if chosen:
        said = f"{finding.detail}; only {len(chosen)} topics were to be recorded"
        return Finding(finding.name, finding.holds, said)
    return finding


def _file(name: str, what: str, cid: str, claimed: str) -> Finding:
    if not claimed:
        return Finding(name, None, f"the {what} is {cid}, and nobody says which it should be")
    if cid != claimed:
        return Finding(name, False, f"the {what} is {cid}, and it should be {claimed}")
    return Finding(name, True, f"the {what} is {cid}")


def _numbers(text: str) -> frozenset[int]:
    """Numbers separated by commas; what is none is left out, since anybody may have written it."""
    return frozenset(int(word) for word in text.split(",") if word.isascii() and word.isdigit() and len(word) < 20)
