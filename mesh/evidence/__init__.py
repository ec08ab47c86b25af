"""Recordings as evidence: whether an objective, a result and what the chain says of them belong together."""

from mesh.evidence.claims import Claim, Finding, Verdict, check_end
from mesh.evidence.verification import verify
