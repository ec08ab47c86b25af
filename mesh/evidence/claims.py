"""What is claimed of a job, by the chain or by a signed Result. Pure: no I/O."""

from __future__ import annotations

from typing import TYPE_CHECKING

from msgspec import Struct

from mesh.errors import InvalidMessage
from mesh.evidence.findings import Finding
from schemas import Result
from schemas.signing import verify as verify_signature

if TYPE_CHECKING:
    from schemas import Liability


class Claim(Struct, frozen=True, kw_only=True):
    """A job as it is claimed to be; a field is empty (or None) where nobody says so.

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
        """What a contract says."""
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
    """Whether the contract has ended with a result, which it takes only with the promisor's signature."""
    match claim:
        case Claim(finalized=None):
            return Finding("finalized", None, "no contract was looked at")
        case Claim(finalized=False):
            return Finding("finalized", False, "the contract has not ended, and holds no result yet")
        case Claim(result=""):
            return Finding("finalized", False, "the contract was refunded or cancelled, and holds no result")
    paid = "paid" if claim.success else "refunded, as the work was not done"
    return Finding("finalized", True, f"the contract has ended with this result: {paid}")


def check_signature(claim: Claim, message: bytes | None, *, recording: str) -> Finding:
    """Whose signature is on the result: `message` is a Result as it travels, `recording` the CID of the file at hand.

    Without a message, a finalized contract is the proof: it compares the signature with its promisor before it takes a
    result.
    """
    if message is None:
        if claim.finalized and claim.result:
            return Finding("signature", True, f"{claim.promisor} signed it: the contract takes no other")
        return Finding("signature", None, "there is neither a Result message nor an ended contract")
    try:
        verified = verify_signature(message)
    except InvalidMessage as error:
        return Finding("signature", False, f"the Result message: {error.detail}")
    result = verified.message
    if not isinstance(result, Result):
        return Finding("signature", False, f"the message is no Result but of the kind {type(result).__name__}")
    if result.result != recording:
        return Finding("signature", False, f"the Result message is for another recording, {result.result}")
    if claim.liability and result.liability != claim.liability:
        return Finding("signature", False, f"the Result message is for another liability, {result.liability}")
    if claim.promisor and verified.signer != claim.promisor:
        return Finding("signature", False, f"{verified.signer} signed it, and the promisor is {claim.promisor}")
    whom = "the promisor, " if claim.promisor else ""
    return Finding("signature", True, f"{whom}{verified.signer}, signed it with success {str(result.success).lower()}")


def supplemented(claim: Claim, message: bytes | None) -> Claim:
    """The claim with what a signed Result says where the chain says nothing: for an arbiter without a chain."""
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
