"""`aira doctor`: what stands in the way of a role on this machine, what it is, and what to do about it."""

from __future__ import annotations

from mesh.doctor.case import Case
from mesh.doctor.checks import Check, Checked, examine
from mesh.doctor.findings import Finding, Verdict, broken, doubtful, sound
from mesh.doctor.plan import checks_for

__all__ = ["Case", "Check", "Checked", "Finding", "Verdict", "broken", "checks_for", "doubtful", "examine", "sound"]
