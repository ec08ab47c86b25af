"""`aira doctor`: checks whether this machine can run a role, and suggests a fix for each problem."""

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
