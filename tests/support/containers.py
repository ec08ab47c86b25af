"""Real containers for tests: a Docker daemon with a folder of its own, which is started for a run and ended after it.

Nothing of the user's own Docker is seen or touched. No image is pulled: what the Dockerfile begins with is made from
the peers (see `BASE_IMAGE` and `FOUNDRY_IMAGE`).
"""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import tarfile
import tempfile
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

from tests.support.peers import require
from tests.support.processes import Server, ServerFailed

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

BASE_IMAGE = "localhost/aira-base:latest"
FOUNDRY_IMAGE = "localhost/aira-foundry:latest"
SECONDS = 60.0
"""Given to one command of the engine on a machine that has other things to do."""

NETWORKS = "10.213.0.0/16"
SAID_LINES = 30
CHAINS = ("DOCKER", "DOCKER-USER", "DOCKER-ISOLATION-STAGE-1", "DOCKER-ISOLATION-STAGE-2")
"""What Docker adds to the firewall, and leaves there."""
FORWARDING = Path("/proc/sys/net/ipv4/ip_forward")


class EngineFailed(Exception):
    """A command of the engine ended with an error or took too long; the text ends with what it said."""

    def __init__(self, command: Sequence[str], reason: str, said: str) -> None:
        end = "\n".join(said.splitlines()[-SAID_LINES:])
        super().__init__(f"{' '.join(command)}: {reason}\n{end or '(it said nothing)'}")
        self.reason = reason
        self.said = said


class DockerDaemon(Server):
    """A `dockerd` whose images, containers and networks are in its folder. Needs root.

    It ends with its containers when the process that started it ends, however that is.
    """

    name = "docker"

    def __init__(self) -> None:
        self._program: Path = require("dockerd")
        super().__init__()
        self.socket = self.folder / "docker.sock"
        self._rules, self._forwarding = _rules("filter"), FORWARDING.read_text()

    def command(self) -> Sequence[str | Path]:
        settings = self.folder / "daemon.json"
        settings.write_text("{}")
        options = {
            "config-file": settings,
            "data-root": self.folder / "data",
            "exec-root": self.folder / "exec",
            "pidfile": self.folder / "pid",
            "host": f"unix://{self.socket}",
            "bridge": "none",
            "default-address-pool": f"base={NETWORKS},size=24",
        }
        return [
            "setpriv",
            "--pdeathsig",
            "TERM",
            self._program,
            *(f"--{name}={value}" for name, value in options.items()),
        ]

    def is_ready(self) -> bool:
        return "API listen on" in self.log()

    def close(self) -> None:
        """End it, and take back what it has changed in the firewall of a machine that has no other Docker."""
        self.stop()
        if f":{CHAINS[0]} " not in self._rules:
            _forget_chains(keeps_policy=":FORWARD DROP" in self._rules)
            FORWARDING.write_text(self._forwarding)
        super().close()


class Engine:
    """Docker. Call it with the words of a command: `engine("ps", "--all")` gives what the command prints."""

    def __init__(self, socket: Path) -> None:
        self._docker = require("docker")
        self.environment = {
            **{name: value for name, value in os.environ.items() if not name.startswith(("AIRA_", "COMPOSE_"))},
            "DOCKER_HOST": f"unix://{socket}",
            "DOCKER_BUILDKIT": "1",
        }

    def __call__(self, *words: str | Path, seconds: float = SECONDS) -> str:
        """Run a command of Docker to its end; give its standard output, or raise `EngineFailed`."""
        return self.run([self._docker, *words], seconds=seconds)

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
            self("import", "--change", settings, base, BASE_IMAGE, seconds=300)
            with _image_of(anvil, "usr/local/bin/anvil") as tar:
                self("import", tar, FOUNDRY_IMAGE, seconds=300)
            self("run", "--rm", "--network", "none", BASE_IMAGE, "true")
        except EngineFailed as error:
            _cannot(f"no container runs on this machine: {error}")


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


def _rules(table: str) -> str:
    command = ["iptables-save", "-t", table]
    return subprocess.run(command, capture_output=True, text=True, timeout=SECONDS, check=True).stdout


def _forget_chains(*, keeps_policy: bool) -> None:
    """Remove the chains of Docker and the rules that name them, and forward packets as before."""
    for table in ("filter", "nat"):
        lines = [line for line in _rules(table).splitlines() if not set(CHAINS) & set(re.split(r"[ :]", line))]
        text = "\n".join(lines) + "\n"
        if not keeps_policy:
            text = text.replace(":FORWARD DROP", ":FORWARD ACCEPT")
        subprocess.run(["iptables-restore", "-T", table], input=text, text=True, timeout=SECONDS, check=True)


@pytest.fixture(scope="session")
def engine() -> Iterator[Engine]:
    """The engine, with the images that others begin with."""
    require("docker")
    if os.geteuid() != 0:
        _cannot("containers need root here")
    try:
        daemon = DockerDaemon().__enter__()
    except ServerFailed as error:
        _cannot(f"Docker does not start on this machine: {error}")
    try:
        ready = Engine(daemon.socket)
        ready.prepare()
        yield ready
    finally:
        daemon.close()
