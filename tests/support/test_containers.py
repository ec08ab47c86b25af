from __future__ import annotations

import hashlib
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from peers.recipes import CERTIFICATES
from tests.support.containers import BASE_IMAGE, Engine, engine
from tests.support.waiting import wait_until

__all__ = ["engine"]

ROOT = Path(__file__).parents[2]


RUNS_DOCKER = """
import time
from tests.support.containers import DockerDaemon
daemon = DockerDaemon().__enter__()
print(daemon.folder, flush=True)
time.sleep(600)
"""


@pytest.mark.compose
@pytest.mark.usefixtures("engine")  # which takes back at the end what a daemon has changed in the firewall
def test_a_daemon_ends_with_the_run_that_started_it() -> None:
    command = [sys.executable, "-c", RUNS_DOCKER]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, cwd=ROOT) as run:
        assert run.stdout is not None
        folder = Path(run.stdout.readline().strip())
        running = (folder / "pid").exists()
        run.kill()
    assert running
    wait_until(lambda: not (folder / "pid").exists(), what="the end of the daemon", seconds=60)
    shutil.rmtree(folder)


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
