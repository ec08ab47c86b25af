"""What can be wrong with identities and with the roster."""

from __future__ import annotations

from typing import TYPE_CHECKING

from mesh.errors import ConfigurationError

if TYPE_CHECKING:
    from pathlib import Path


class IdentityError(ConfigurationError):
    """A certificate or a key is not what it has to be; `path` is the file."""

    code = "identity-error"

    def __init__(self, path: Path, why: str, *, hint: str = "") -> None:
        super().__init__(f"{path}: {why}", hint=hint or "`aira identity new` makes certificates and keys")
        self.path = path


class RosterError(ConfigurationError):
    """The roster can't be used; `where` is the file and, where it is known, the entry."""

    code = "roster-error"

    def __init__(self, where: str, why: str, *, hint: str = "") -> None:
        super().__init__(f"the roster {where}: {why}", hint=hint)
        self.where = where
