"""Running an installer: its output goes to a log file, and a failure is one line that says where to read on."""

from __future__ import annotations

import os
import subprocess
from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path


class InstallFailed(Exception):
    """A recipe could not do its work; `reason` is one line for the table."""

    def __init__(self, reason: str) -> None:
        super().__init__(reason)
        self.reason = reason


@dataclass(frozen=True, kw_only=True)
class Runner:
    """Runs the commands of one recipe, one after the other, all into the file `log`.

    `environment` is added to this process's own; nothing is read from the terminal.
    """

    log: Path
    environment: Mapping[str, str]

    def __call__(self, command: Sequence[str | Path], *, timeout: float, cwd: Path | None = None) -> None:
        """Run `command` to its end within `timeout` seconds; raise `InstallFailed` unless it exits with 0."""
        words = [str(word) for word in command]
        self.log.parent.mkdir(parents=True, exist_ok=True)
        with self.log.open("ab") as log:
            log.write(f"$ {' '.join(words)}\n".encode())
            log.flush()
            try:
                subprocess.run(
                    words,
                    stdin=subprocess.DEVNULL,
                    stdout=log,
                    stderr=subprocess.STDOUT,
                    cwd=cwd,
                    env={**os.environ, **self.environment},
                    timeout=timeout,
                    check=True,
                )
            except FileNotFoundError:
                raise InstallFailed(f"{words[0]} is not installed") from None
            except subprocess.TimeoutExpired:
                raise InstallFailed(f"{words[0]} took longer than {timeout:.0f} s, see {self.log}") from None
            except subprocess.CalledProcessError as error:
                raise InstallFailed(f"{words[0]} ended with {error.returncode}, see {self.log}") from None
