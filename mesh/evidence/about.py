"""Whose recording it says it is, against whose it should be. Pure: no I/O."""

from __future__ import annotations

from typing import TYPE_CHECKING

from mesh.errors import InvalidAddress
from mesh.evidence.findings import Finding
from mesh.recording import ABOUT
from schemas import parse_address

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from mesh.evidence.claims import Claim


def check_about(claim: Claim, metadata: Mapping[str, Mapping[str, str]]) -> Iterator[Finding]:
    """Compare what the recording's metadata names with the claim, a finding each."""
    about = metadata.get(ABOUT)
    if about is None:
        yield Finding("liability", False, f"the recording has no metadata {ABOUT!r}, and so names no liability")
        return
    yield _compared("liability", "liability", about.get("liability", ""), claim.liability)
    yield _compared("agent", "agent", about.get("agent", ""), claim.promisor)
    yield _compared("lighthouse", "lighthouse", about.get("lighthouse", ""), claim.lighthouse)
    yield _compared("objective", "objective", about.get("objective", ""), claim.objective)


def _compared(name: str, what: str, said: str, claimed: str) -> Finding:
    if not said:
        return Finding(name, False, f"the recording names no {what}")
    if not claimed:
        return Finding(
            name, None, f"the recording names the {what} {said[:80]!r}, and there is nothing to compare it to"
        )
    if _canonical(said) != _canonical(claimed):
        return Finding(name, False, f"the recording names the {what} {said[:80]!r}, and it should be {claimed}")
    return Finding(name, True, f"the recording names the {what} {claimed}")


def _canonical(text: str) -> str:
    """An address in its one form; anything else as it is."""
    try:
        return parse_address(text)
    except InvalidAddress:
        return text
