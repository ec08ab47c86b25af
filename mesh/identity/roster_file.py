"""Changing a roster's file by what the command line does, without touching anything else that people wrote there."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING

from mesh.errors import ConfigurationError
from mesh.identity.errors import RosterError
from mesh.identity.roster import Roster, entry_of, roster_from

if TYPE_CHECKING:
    from pathlib import Path

    from mesh.identity.roster import Member


def with_member(path: Path, member: Member) -> str:
    """The text of the roster with one member more; the file need not exist. Raises `RosterError` if he can't be."""
    before = _text(path) if path.exists() else ""
    if before and not before.endswith("\n"):
        before += "\n"
    text = f"{before}\n{entry_of(member)}" if before else entry_of(member)
    roster_from(text, where=str(path))
    return text


def with_fingerprint(path: Path, old: str, new: str) -> str:
    """The text of the roster with a renewed certificate's fingerprint in place of the old one's.

    Raises `RosterError` if nobody has the old one.
    """
    before = _text(path)
    roster: Roster = roster_from(before, where=str(path))
    if old not in (member.fingerprint for member in roster.member) or old not in before:
        raise RosterError(str(path), f"no member has the certificate with the fingerprint {old}")
    return before.replace(old, new)


def write_roster(path: Path, text: str) -> None:
    """Put the text in the file's place, in one step. Raises `ConfigurationError`."""
    fresh = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        fresh.write_text(text, encoding="utf-8")
        if path.exists():
            fresh.chmod(path.stat().st_mode & 0o777)
        fresh.replace(path)
    except OSError as error:
        raise ConfigurationError(f"can't write the roster {path}: {error.strerror}") from None


def _text(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8")
    except OSError as error:
        raise RosterError(str(path), f"it can't be read: {error.strerror}") from None
    except UnicodeDecodeError:
        raise RosterError(str(path), "it is not UTF-8 text") from None
