"""What is claimed of a job, by its contract or a signed Result, and whether signature and metadata agree. No I/O."""

from __future__ import annotations

from typing import TYPE_CHECKING

from msgspec import Struct

from mesh.errors import InvalidAddress, InvalidMessage
from mesh.recording import ABOUT
from schemas import Result, parse_address
from schemas.signing import verify as verify_signature

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from schemas import Liability


class Finding(Struct, frozen=True):
    """The outcome of one check. `holds` is None if it can't be decided; `detail` is for people.

    `name` is machine-readable: `objective-file`, `result-file`, `finalized`, `signature`, `readable`, `statistics`,
    `closed`, `sequence`, `times`, `duplicates`, `roles`, `clock`, `period`, `liability`, `agent`, `lighthouse`,
    `objective`, `played`.
    """

    name: str
    holds: bool | None
    detail: str


class Verdict(Struct, frozen=True):
    """All findings, in the order of the checks."""

    findings: tuple[Finding, ...]

    @property
    def holds(self) -> bool:
        """Whether no check failed."""
        return all(finding.holds is not False for finding in self.findings)

    def of(self, name: str) -> Finding | None:
        """The finding of that name, if any."""
        return next((finding for finding in self.findings if finding.name == name), None)


class Claim(Struct, frozen=True, kw_only=True):
    """What is claimed of a job; a field is empty (or None) if nothing is claimed.

    `liability`, `promisor` and `lighthouse` are addresses (EIP-55), `objective` and `result` CIDs. `finalized` and
    `success` are the contract's.
    """

    liability: str = ""
    promisor: str = ""
    lighthouse: str = ""
    objective: str = ""
    result: str = ""
    success: bool | None = None
    finalized: bool | None = None

    @classmethod
    def of_contract(cls, liability: Liability) -> Claim:
        """The claim of a contract."""
        return cls(
            liability=liability.address,
            promisor=liability.promisor,
            lighthouse=liability.lighthouse,
            objective=liability.objective,
            result=liability.result,
            success=liability.is_success if liability.is_finalized else None,
            finalized=liability.is_finalized,
        )


def check_end(claim: Claim) -> Finding:
    """Whether the contract has ended with a result, which it accepts only with the promisor's signature."""
    match claim:
        case Claim(finalized=None):
            return Finding("finalized", None, "no contract was checked")
        case Claim(finalized=False):
            return Finding("finalized", False, "the contract has not ended, and holds no result yet")
        case Claim(result=""):
            return Finding("finalized", False, "the contract was refunded or cancelled, and holds no result")
    paid = "paid" if claim.success else "refunded, as the work was not done"
    return Finding("finalized", True, f"the contract has ended with this result: {paid}")


def check_signature(claim: Claim, message: bytes | None, *, recording: str) -> Finding:
    """Who signed the result. `message` is the encoded Result, `recording` the CID of the file at hand.

    Without a message, a finalized contract is the proof: it accepts a result only with its promisor's signature.
    """
    if message is None:
        if claim.finalized and claim.result:
            return Finding("signature", True, f"{claim.promisor} signed it: the contract accepts no other")
        return Finding("signature", None, "there is neither a Result message nor an ended contract")
    try:
        verified = verify_signature(message)
    except InvalidMessage as error:
        return Finding("signature", False, f"the Result message: {error.detail}")
    result = verified.message
    if not isinstance(result, Result):
        return Finding("signature", False, f"the message is not a Result but a {type(result).__name__}")
    if result.result != recording:
        return Finding("signature", False, f"the Result message is for another recording, {result.result}")
    if claim.liability and result.liability != claim.liability:
        return Finding("signature", False, f"the Result message is for another liability, {result.liability}")
    if claim.promisor and verified.signer != claim.promisor:
        return Finding("signature", False, f"{verified.signer} signed it, and the promisor is {claim.promisor}")
    whom = "the promisor, " if claim.promisor else ""
    return Finding("signature", True, f"{whom}{verified.signer}, signed it with success {str(result.success).lower()}")


def supplemented(claim: Claim, message: bytes | None) -> Claim:
    """The claim, completed from a signed Result where no contract is known: for an arbiter without a chain."""
    if message is None or claim.liability:
        return claim
    try:
        verified = verify_signature(message)
    except InvalidMessage:
        return claim
    result = verified.message
    if not isinstance(result, Result):
        return claim
    return Claim(
        liability=result.liability,
        promisor=claim.promisor or verified.signer,
        lighthouse=claim.lighthouse,
        objective=claim.objective,
        result=claim.result or result.result,
        success=result.success if claim.success is None else claim.success,
        finalized=claim.finalized,
    )


def check_about(claim: Claim, metadata: Mapping[str, Mapping[str, str]]) -> Iterator[Finding]:
    """Compare the job in the recording's metadata with the claim, one finding for each field."""
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
        return Finding(name, None, f"the recording names the {what} {said[:80]!r}, with nothing to compare it to")
    if _canonical(said) != _canonical(claimed):
        return Finding(name, False, f"the recording names the {what} {said[:80]!r}, and it should be {claimed}")
    return Finding(name, True, f"the recording names the {what} {claimed}")


def _canonical(text: str) -> str:
    """An address in its canonical form; any other text unchanged."""
    try:
        return parse_address(text)
    except InvalidAddress:
        return text
