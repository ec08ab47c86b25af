"""A compose project for tests: started, disturbed and repaired by the names of its services, and removed at the end."""

from __future__ import annotations

import json
import secrets
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

from tests.support.containers import SECONDS
from tests.support.peers import require

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from tests.support.containers import Engine

UP_SECONDS = 300.0
"""For ten containers on a machine that has other things to do."""
STOP_SECONDS = 5


class Project:
    """One project with a name of its own. Use it in `with`: the rest is removed by force at the end.

    `variables` stand in for an `.env` file; the one that lies beside the compose file is not read.
    """

    def __init__(
        self,
        engine: Engine,
        folder: Path,
        *,
        files: Sequence[Path],
        profiles: Sequence[str] = (),
        variables: Mapping[str, str] | None = None,
    ) -> None:
        self.engine = engine
        self.name = f"aira-test-{secrets.token_hex(4)}"
        environment = folder / f"{self.name}.env"
        environment.write_text("".join(f"{name}={value}\n" for name, value in (variables or {}).items()))
        options = [f"--file={file}" for file in files] + [f"--profile={profile}" for profile in profiles]
        self._compose: list[str | Path] = [
            require("docker-compose"),
            f"--project-name={self.name}",
            f"--env-file={environment}",
            *options,
        ]
        self._place = files[0].parent

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exc_info: object) -> None:
        self._sweep()

    def compose(self, *words: str, seconds: float = SECONDS) -> str:
        """Run a command of docker-compose; returns its output."""
        return self.engine.run([*self._compose, *words], seconds=seconds, cwd=self._place)

    def up(self, *services: str) -> None:
        """Bring up these services, or all; none is built."""
        self.compose("up", "--detach", "--no-build", *services, seconds=UP_SECONDS)

    def down(self) -> None:
        """Remove all services with their volumes, as a user does. `leftovers` lists what remains."""
        self.compose("down", "--volumes", "--timeout", str(STOP_SECONDS), seconds=UP_SECONDS)

    def leftovers(self) -> list[str]:
        """The resources of this project: containers, volumes, networks."""
        found = []
        for kind, names in self._mine().items():
            found += [f"{kind} {name}" for name in names]
        return found

    def container(self, service: str) -> str:
        """The name of the service's container."""
        return f"{self.name}_{service}_1"

    def containers(self) -> list[str]:
        """The names of all containers, also of those that have ended."""
        return self.engine("ps", "--all", "--filter", f"name={self.name}", "--format", "{{.Names}}").split()

    def kill(self, service: str) -> None:
        """End the service as a power cut would (SIGKILL)."""
        self.engine("kill", "--signal", "KILL", self.container(service))
        self.engine("wait", self.container(service))

    def start(self, service: str) -> None:
        """Start a service that was killed or stopped, with the state it had."""
        self.engine("start", self.container(service))

    def stop(self, service: str) -> None:
        """Ask the service to end."""
        self.engine("stop", "--time", str(STOP_SECONDS), self.container(service))

    def pause(self, service: str) -> None:
        """Freeze the service: it keeps its connections but does not answer until `unpause`."""
        self.engine("pause", self.container(service))

    def unpause(self, service: str) -> None:
        """Let a frozen service go on."""
        self.engine("unpause", self.container(service))

    def disconnect(self, service: str, network: str = "default") -> None:
        """Disconnect the service from a network: its packets are lost without a notice."""
        self.engine("network", "disconnect", f"{self.name}_{network}", self.container(service))

    def connect(self, service: str, network: str = "default") -> None:
        """Connect the service again under its name; its address can be another one."""
        self.engine("network", "connect", "--alias", service, f"{self.name}_{network}", self.container(service))

    def networks(self, service: str) -> set[str]:
        """The networks that the service is on, by their names in the compose file."""
        return {name.removeprefix(f"{self.name}_") for name in self.facts(service)["NetworkSettings"]["Networks"]}

    def variable(self, service: str, name: str) -> str:
        """A variable of the service's environment."""
        (value,) = [line for line in self.facts(service)["Config"]["Env"] if line.startswith(f"{name}=")]
        return str(value).partition("=")[2]

    def address(self, service: str) -> str:
        """The service's IP address in one of its networks, which this machine reaches too."""
        networks = self.facts(service)["NetworkSettings"]["Networks"]
        return str(next(network["IPAddress"] for network in networks.values()))

    def facts(self, service: str) -> Any:
        """The engine's description of the service's container."""
        return self.engine.facts("inspect", self.container(service))[0]

    def is_running(self, service: str) -> bool:
        """Whether its process runs."""
        return bool(self.facts(service)["State"]["Running"])

    def exit_code(self, service: str) -> int | None:
        """The exit code of the service; None while it runs."""
        state = self.facts(service)["State"]
        return None if state["Running"] or state["Status"] != "exited" else int(state["ExitCode"])

    def log(self, service: str) -> str:
        """The log of the service, stdout and stderr."""
        return log_text(Path(self.facts(service)["LogPath"]))

    def execute(self, service: str, *words: str, seconds: float = SECONDS) -> str:
        """Run a command inside the service's container; returns its output."""
        return self.engine("exec", self.container(service), *words, seconds=seconds)

    def _mine(self) -> dict[str, list[str]]:
        """By name, not by label: containers that the engine creates by itself have no label of the project."""
        named = ["--format", "{{.Name}}", "--filter", f"name={self.name}"]
        return {
            "container": self.containers(),
            "volume": self.engine("volume", "ls", *named).split(),
            "network": self.engine("network", "ls", *named).split(),
        }

    def _sweep(self) -> None:
        """Remove everything by force, also containers that are paused, incomplete or needed by another."""
        paused = self.engine(
            "ps",
            "--filter",
            f"label=com.docker.compose.project={self.name}",
            "--filter",
            "status=paused",
            "--format",
            "{{.Names}}",
        )
        for name in paused.split():
            self.engine("unpause", name)
        for kind, names in self._mine().items():
            if not names:
                continue
            if kind == "container":
                self.engine("rm", "--force", "--volumes", *names)
            else:
                self.engine(kind, "rm", *names)


def log_text(file: Path) -> str:
    """What a container's log file holds: a line of JSON for each line, or part of one."""
    lines = file.read_text(errors="replace").splitlines() if file.exists() else []
    return "".join(json.loads(line)["log"] for line in lines if line.endswith("}"))
