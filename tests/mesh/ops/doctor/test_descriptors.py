"""The file descriptors of a router: what it may open, and what doctor says of too few."""

from __future__ import annotations

import resource
import subprocess
import sys
from typing import TYPE_CHECKING

from mesh.network import endpoints
from mesh.ops.doctor._machine import check_descriptors
from mesh.ops.doctor.checks import CheckStatus

if TYPE_CHECKING:
    import pytest

LIMITED = """
import resource
resource.setrlimit(resource.RLIMIT_NOFILE, (64, HARD))
from mesh.network.endpoints import allow_sessions
allow_sessions(300)
print(resource.getrlimit(resource.RLIMIT_NOFILE)[0])
"""


def allowed(hard: int) -> int:
    """The soft limit of a process that wants 300 sessions."""
    script = LIMITED.replace("HARD", str(hard))
    ran = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=60, check=True)
    return int(ran.stdout)


def test_a_router_raises_its_soft_limit_to_what_its_sessions_need() -> None:
    assert allowed(hard=1000) == 300 + endpoints.SPARE_DESCRIPTORS
    assert allowed(hard=200) == 200


def test_a_hard_limit_below_the_sessions_is_a_warning(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(resource, "getrlimit", lambda _: (64, 1100))

    result = check_descriptors(5000)

    assert (result.status, result.code) == (CheckStatus.WARN, "few-descriptors")
    assert "--max-sessions 1000" in result.hint
    assert check_descriptors(1000).status is CheckStatus.OK


def test_without_a_limit_there_is_room(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(resource, "getrlimit", lambda _: (64, resource.RLIM_INFINITY))
    assert check_descriptors(10**6).status is CheckStatus.OK
