"""`aira doctor`: checks what a role needs on this machine, and says what is wrong and what to do about it."""

from __future__ import annotations

from mesh.doctor.checks import Check, CheckResult, CheckStatus, CompletedCheck, failed, passed, run_checks, warning
from mesh.doctor.context import DoctorContext, SerialSettings, with_identity
from mesh.doctor.registry import checks_for

__all__ = [
    "Check",
    "CheckResult",
    "CheckStatus",
    "CompletedCheck",
    "DoctorContext",
    "SerialSettings",
    "checks_for",
    "failed",
    "passed",
    "run_checks",
    "warning",
    "with_identity",
]
