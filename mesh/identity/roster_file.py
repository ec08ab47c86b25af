"""Changing a roster's file by what the command line does, without touching anything else that people wrote there."""

from __future__ import annotations

import os
import re
from typing import TYPE_CHECKING

from mesh.errors import ConfigurationError
from mesh.identity.errors import RosterError
from mesh.identity.roster import entry_of, roster_from

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


def with_fingerprint(path: Path, address: str, *, old: str, new: str) -> str:
    """The text of the roster with the fingerprint of a renewed certificate in place of the old one's; as it is, where
    it names none of this member.

    Raises `RosterError` where he may have no new one: he is not in it, was revoked, or has another certificate there.
    """
    before = _text(path)
    member = roster_from(before, where=str(path)).find(address)
    if member is None:
        raise RosterError(str(path), f"no member has the address {address}")
    where = f"{path}, member {member.name!r}"
    if member.revoked:
        raise RosterError(
            where, "it is revoked, so its certificate is not renewed", hint="delete the folder of its certificate"
        )
    if member.fingerprint not in ("", old):
        hint = "is this folder an old one? If the roster is what is old, write this fingerprint there"
        raise RosterError(where, f"it has another certificate than the one with the fingerprint {old}", hint=hint)
    return re.sub(":?".join(re.findall("..", old)), new, before, flags=re.IGNORECASE)


def write_roster(path: Path, text: str) -> None:
    """Put the text in the file's place, in one step. Raises `ConfigurationError`."""
    fresh = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with fresh.open("w", encoding="utf-8") as file:
            file.write(text)
            file.flush()
            os.fsync(file.fileno())
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
