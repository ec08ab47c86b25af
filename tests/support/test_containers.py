from __future__ import annotations

import json
import subprocess
from typing import TYPE_CHECKING

import pytest

from tests.support.peers import require

if TYPE_CHECKING:
    from pathlib import Path


def said(*command: str | Path) -> str:
    return subprocess.run(command, capture_output=True, text=True, timeout=60, check=True).stdout


def test_podman_knows_its_host() -> None:
    facts = json.loads(said(require("podman"), "--runtime", require("runc"), "info", "--format", "json"))
    assert facts["host"]["ociRuntime"]["version"].startswith("runc version")


@pytest.mark.parametrize(("name", "words"), [("runc", "runc version"), ("debootstrap", "debootstrap 1.")])
def test_what_podman_needs_is_there(name: str, words: str) -> None:
    assert said(require(name), "--version").startswith(words)


def test_podman_compose_is_the_pinned_version() -> None:
    require("podman")
    assert "podman-compose version 1.6.0" in said(require("podman-compose"), "version")
