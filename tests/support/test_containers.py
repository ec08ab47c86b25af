from __future__ import annotations

import hashlib
import json
import subprocess
from typing import TYPE_CHECKING

import pytest

from peers.recipes import CERTIFICATES
from tests.support.containers import BASE_IMAGE, Engine, engine
from tests.support.peers import require

if TYPE_CHECKING:
    from pathlib import Path

__all__ = ["engine"]


def said(*command: str | Path) -> str:
    return subprocess.run(command, capture_output=True, text=True, timeout=60, check=True).stdout


def test_podman_knows_its_host() -> None:
    facts = json.loads(said(require("podman"), "--runtime", require("runc"), "info", "--format", "json"))
    assert facts["host"]["ociRuntime"]["version"].startswith("runc version")


@pytest.mark.parametrize(("name", "words"), [("runc", "runc version"), ("debootstrap", "debootstrap 1.")])
def test_the_requirements_of_podman_are_installed(name: str, words: str) -> None:
    assert said(require(name), "--version").startswith(words)


def test_podman_compose_is_the_pinned_version() -> None:
    require("podman")
    assert "podman-compose version 1.6.0" in said(require("podman-compose"), "version")


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
    (tmp_path / "containers.conf").write_text('[engine]\nruntime = "a runtime that is not there"\n')
    monkeypatch.setitem(engine.environment, "CONTAINERS_CONF", str(tmp_path / "containers.conf"))
    monkeypatch.setenv("AIRA_REQUIRE_PEERS", required)
    with pytest.raises(outcome, match=r"no container runs on this machine: [\s\S]*a runtime that is not there"):
        engine.prepare()
