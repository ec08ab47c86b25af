"""Real containers for tests: podman with a store and a configuration of its own, kept between runs in the peers' cache.

Nothing of the user's own podman is seen or touched. No image is pulled: what the Dockerfile begins with is made from
the peers (see `BASE_IMAGE` and `FOUNDRY_IMAGE`), and what is built on them stays as a cache for a day.
"""

from __future__ import annotations

import hashlib
import json
import os
import signal
import subprocess
import tarfile
import tempfile
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

from peers.recipes import cache_folder
from tests.support.peers import require

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

BASE_IMAGE = "localhost/aira-base:latest"
FOUNDRY_IMAGE = "localhost/aira-foundry:latest"
SECONDS = 60.0
"""Given to one command of the engine on a machine that has other things to do."""

CACHE_AGE = "24h"
NETWORKS = "10.213.0.0/16"
SAID_LINES = 30

_CONFIGURATION = """\
[containers]
default_ulimits = ["nofile=20000:20000", "nproc=4096:4096"]
log_driver = "k8s-file"

[engine]
runtime = "runc"
cgroup_manager = "cgroupfs"
events_logger = "file"
tmp_dir = "{state}/tmp"

[network]
network_config_dir = "{store}/networks"
default_subnet_pools = [{{"base" = "{networks}", "size" = 24}}]
"""

_STORAGE = """\
[storage]
driver = "overlay"
graphroot = "{store}/root"
runroot = "{state}/run"
"""


class EngineFailed(Exception):
    """A command of the engine ended with an error or took too long; the text ends with what it said."""

    def __init__(self, command: Sequence[str], reason: str, said: str) -> None:
        end = "\n".join(said.splitlines()[-SAID_LINES:])
        super().__init__(f"{' '.join(command)}: {reason}\n{end or '(it said nothing)'}")
        self.reason = reason
        self.said = said


class Engine:
    """Podman. Call it with the words of a command: `engine("ps", "--all")` gives what the command prints.

    The state of running containers is below /run, which is empty after the machine was switched off; the images are in
    the peers' cache. Both are this cache folder's own.
    """

    def __init__(self) -> None:
        self._podman = require("podman")
        require("runc")
        if os.geteuid() != 0:
            _cannot("containers need root here: the base image is made by debootstrap")
        store = cache_folder() / "containers"
        state = Path("/run") / f"aira-containers-{hashlib.sha256(str(store).encode()).hexdigest()[:8]}"
        store.mkdir(parents=True, exist_ok=True)
        (store / "containers.conf").write_text(_CONFIGURATION.format(store=store, state=state, networks=NETWORKS))
        (store / "storage.conf").write_text(_STORAGE.format(store=store, state=state))
        self.environment = {
            **{name: value for name, value in os.environ.items() if not name.startswith(("AIRA_", "COMPOSE_"))},
            "CONTAINERS_CONF": str(store / "containers.conf"),
            "CONTAINERS_STORAGE_CONF": str(store / "storage.conf"),
        }

    def __call__(self, *words: str | Path, seconds: float = SECONDS) -> str:
        """Run a command of podman to its end; give its standard output, or raise `EngineFailed`."""
        return self.run([self._podman, *words], seconds=seconds)

    def run(self, command: Sequence[str | Path], *, seconds: float = SECONDS, cwd: Path | None = None) -> str:
        """Run a program that finds this engine; give its standard output, or raise `EngineFailed`.

        It is killed with all that it started when the time is up. Its output goes to files: a container's monitor that
        holds a pipe open would keep us waiting for its end.
        """
        words = [str(word) for word in command]
        with tempfile.TemporaryFile() as output, tempfile.TemporaryFile() as errors:
            process = subprocess.Popen(
                words,
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=errors,
                cwd=cwd,
                env=self.environment,
                start_new_session=True,
            )
            try:
                code = process.wait(seconds)
            except BaseException as error:
                os.killpg(process.pid, signal.SIGKILL)
                process.wait(SECONDS)
                if not isinstance(error, subprocess.TimeoutExpired):
                    raise
                said = _text(output) + _text(errors)
                raise EngineFailed(words, f"took longer than {seconds:g} s", said) from None
            if code != 0:
                raise EngineFailed(words, f"ended with {code}", _text(output) + _text(errors))
            return _text(output)

    def facts(self, *words: str) -> Any:
        """As calling it, for a command that prints JSON."""
        return json.loads(self(*words) or "null")

    def prepare(self) -> None:
        """Make the images that others begin with, and see that a container runs; skip or fail the test otherwise."""
        base, anvil = require("base-image"), require("anvil")
        try:
            settings = "ENV PIP_CERT=/etc/ssl/certs/ca-certificates.crt"
            self._import(BASE_IMAGE, base, "--change", settings)
            with _image_of(anvil, "usr/local/bin/anvil") as tar:
                self._import(FOUNDRY_IMAGE, tar, stands_for=anvil)
            self("run", "--rm", "--network", "none", BASE_IMAGE, "true")
        except EngineFailed as error:
            _cannot(f"no container runs on this machine: {error}")

    def forget_old_images(self) -> None:
        """Remove the images of runs of earlier days."""
        self("image", "prune", "--force", "--filter", f"until={CACHE_AGE}")

    def _import(self, image: str, tar: Path, *options: str, stands_for: Path | None = None) -> None:
        """Import a tar file as an image, unless it has been. The file it stands for is known by its size and time."""
        source = (stands_for or tar).stat()
        label = f"{source.st_size}-{source.st_mtime_ns}"
        if image not in self(
            "images", "--format", "{{.Repository}}:{{.Tag}}", "--filter", f"label=aira.source={label}"
        ):
            self("import", "--change", f"LABEL aira.source={label}", *options, tar, image, seconds=300)


def _cannot(reason: str) -> None:
    """Skip the test, or fail it if all peers are required."""
    if os.environ.get("AIRA_REQUIRE_PEERS") == "1":
        pytest.fail(reason, pytrace=False)
    pytest.skip(reason)


@contextmanager
def _image_of(program: Path, path: str) -> Iterator[Path]:
    """A tar file with one program at `path`."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "image.tar"
        with tarfile.open(file, "w") as tar:
            tar.add(program, path)
        yield file


def _text(file: Any) -> str:
    file.seek(0)
    return str(file.read().decode(errors="replace"))


@pytest.fixture(scope="session")
def engine() -> Iterator[Engine]:
    """The engine, with the images that others begin with."""
    ready = Engine()
    ready.prepare()
    yield ready
    ready.forget_old_images()
