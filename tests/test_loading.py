"""Packages that load their names when they are asked for."""

from __future__ import annotations

import subprocess
import sys
from importlib import import_module

import pytest

LAZY = ["schemas", "mesh", "mesh.network", "mesh.testing", "bridges.ros1", "bridges.ros2", "bridges.serial"]


@pytest.mark.parametrize("package", LAZY)
def test_every_name_of_the_package_can_be_had(package: str) -> None:
    module = import_module(package)
    assert module.__all__
    for name in module.__all__:
        assert getattr(module, name) is not None


@pytest.mark.parametrize("package", LAZY)
def test_a_name_that_is_not_there_is_told_as_python_tells_it(package: str) -> None:
    with pytest.raises(AttributeError, match=f"module '{package}' has no attribute 'nothing'"):
        import_module(package).nothing  # noqa: B018


@pytest.mark.parametrize(
    ("statement", "absent"),
    [
        ("from schemas import DeviceTopicKey", "schemas.signing"),
        ("from mesh.network import Endpoints", "asyncio"),
        ("from mesh import Settings", "zenoh"),
        ("from bridges.serial import CallFailed", "zenoh"),
    ],
)
def test_what_is_not_asked_for_is_not_loaded(statement: str, absent: str) -> None:
    program = f"import sys; {statement}; sys.exit({absent!r} in sys.modules)"
    assert subprocess.run([sys.executable, "-c", program], check=False).returncode == 0
