"""`aira doctor`: checks whether this machine can run a role, and suggests a fix for each problem."""

from __future__ import annotations

from mesh.doctor.checks import Check, CheckResult, CheckStatus, failed, passed, run_checks, warning
from mesh.doctor.context import DoctorContext
from mesh.doctor.registry import checks_for
