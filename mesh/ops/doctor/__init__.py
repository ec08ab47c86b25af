"""`aira doctor`: checks whether this machine can run a role, and suggests a fix for each problem."""

from __future__ import annotations

from mesh.ops.doctor._registry import checks_for
from mesh.ops.doctor.checks import Check, CheckResult, CheckStatus, DoctorContext, failed, passed, run_checks, warning
