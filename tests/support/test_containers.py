from __future__ import annotations

import hashlib
import subprocess
from typing import TYPE_CHECKING

import pytest

from peers.recipes import CERTIFICATES
from tests.support.containers import BASE_IMAGE, Engine, engine
from tests.support.peers import require

if TYPE_CHECKING:
    from pathlib import Path

__all__ = ["engine"]


@pytest.mark.parametrize(
    ("name", "words"),
    [("dockerd", "Docker version"), ("docker", "Docker version"), ("debootstrap", "debootstrap 1.")],
)
def test_the_requirements_of_containers_are_installed(name: str, words: str) -> None:
    command = [str(require(name)), "--version"]
    assert subprocess.run(command, capture_output=True, text=True, timeout=60, check=True).stdout.startswith(words)


@pytest.mark.compose
def test_the_base_image_has_python_and_the_certificates_of_this_machine(engine: Engine) -> None:
    look = "import hashlib, os, venv; print(hashlib.sha256(open(os.environ['PIP_CERT'], 'rb').read()).hexdigest())"
    trusted = hashlib.sha256(CERTIFICATES.read_bytes()).hexdigest()
    assert engine("run", "--rm", "--network", "none", BASE_IMAGE, "python3", "-c", look) == f"{trusted}\n"


@pytest.mark.compose
@pytest.mark.parametrize(("required", "outcome"), [("0", pytest.skip.Exception), ("1", pytest.fail.Exception)])
def test_the_reason_is_reported_when_no_container_runs(
    engine: Engine, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, required: str, outcome: type[Exception]
) -> None:
    monkeypatch.setitem(engine.environment, "DOCKER_HOST", f"unix://{tmp_path / 'nobody.sock'}")
    monkeypatch.setenv("AIRA_REQUIRE_PEERS", required)
    with pytest.raises(outcome, match=r"no container runs on this machine: [\s\S]*Cannot connect to the Docker daemon"):
        engine.prepare()
