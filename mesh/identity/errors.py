"""Errors of identities and of the roster."""

from __future__ import annotations

from typing import TYPE_CHECKING

from mesh.errors import ConfigurationError

if TYPE_CHECKING:
    from pathlib import Path


class IdentityError(ConfigurationError, code="identity-unusable"):
    """A certificate or a key can't be used; `path` is its file."""

    def __init__(self, path: Path, why: str, *, hint: str = "") -> None:
        super().__init__(f"{path}: {why}", hint=hint or "create certificates and keys with `aira identity new`")
        self.path = path


class RosterError(ConfigurationError, code="roster-unusable"):
    """The roster can't be used; `where` is the file and, if known, the entry."""

    def __init__(self, where: str, why: str, *, hint: str = "") -> None:
        super().__init__(f"the roster {where}: {why}", hint=hint)
        self.where = where
