"""Recordings as evidence: whether an objective, a result and what the chain says of them belong together."""

from mesh.evidence.claims import Claim, check_end
from mesh.evidence.findings import Finding, Verdict
from mesh.evidence.verification import verify

__all__ = ["Claim", "Finding", "Verdict", "check_end", "verify"]
