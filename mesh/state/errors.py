"""What can go wrong with backups of an agent's state."""

from __future__ import annotations

from typing import TYPE_CHECKING

from mesh.errors import ConfigurationError, InputError

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path


class ArchiveUnusable(InputError):
    """A file is no backup, is damaged, or holds what no backup has. Nothing of it was used."""

    code = "archive-unusable"

    def __init__(self, path: Path, why: str, *, hint: str = "take another backup; nothing was changed") -> None:
        super().__init__(f"{path} can't be used: {why}", hint=hint)
        self.path = path


class StateInUse(ConfigurationError):
    """An agent is using the state that was to be replaced."""

    code = "state-in-use"

    def __init__(self, path: Path) -> None:
        super().__init__(f"{path} is in use", hint="stop the agent first")
        self.path = path


class StateExists(ConfigurationError):
    """There is a state where one was to be restored."""

    code = "state-exists"

    def __init__(self, folder: Path, parts: Sequence[str]) -> None:
        super().__init__(
            f"{folder} has a state already: {', '.join(parts)}",
            hint="give another folder with --data-dir, or --existing set-aside to keep the old state beside the new",
        )
        self.folder = folder
        self.parts = tuple(parts)


class NoState(ConfigurationError):
    """There is nothing to back up."""

    code = "no-state"

    def __init__(self, folder: Path) -> None:
        super().__init__(f"there is no agent's state in {folder}", hint="name its folder with --data-dir")
        self.folder = folder


class StateRestless(ConfigurationError):
    """Jobs began and ended faster than they could be copied."""

    code = "state-restless"

    def __init__(self, path: Path) -> None:
        super().__init__(f"the jobs of {path} change too quickly to be copied", hint="try again, or stop the agent")
        self.path = path
