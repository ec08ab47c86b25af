"""Which files must stay, and for whose sake: an empty file for each pin, which outlasts the index and any crash."""

from __future__ import annotations

import os
import re
from typing import TYPE_CHECKING, Final

from mesh.content.files import sync_directory
from mesh.errors import InputError
from schemas.cid import CID_LENGTH, parse_cid

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

_LABEL: Final = re.compile(r"[A-Za-z0-9_-]{1,64}")


class Pins:
    """The pins of one store's directory, each a CID and a label; several processes may set and drop them.

    Whoever deletes files holds the directory's lock, and so must who sets a pin on a file that is there.
    """

    def __init__(self, directory: Path) -> None:
        self._directory = directory / ".pins"
        self._directory.mkdir(exist_ok=True)
        sync_directory(directory)

    def add(self, cid: str, label: str) -> None:
        """Pin a CID, whether or not its file is there yet. Raises `InvalidCid` and `InputError` (the label)."""
        path = self._path(cid, label)
        if not path.exists():
            path.touch()
            sync_directory(self._directory)

    def drop(self, cid: str, label: str) -> None:
        """Take one pin away; nothing happens when it is not there. Raises as `add` does."""
        self._path(cid, label).unlink(missing_ok=True)
        sync_directory(self._directory)

    def release(self, label: str) -> None:
        """Take away all pins of a label. Raises `InputError` if it can't be one."""
        check_label(label)
        for cid, labels in self.by_cid().items():
            if label in labels:
                self._path(cid, label).unlink(missing_ok=True)
        sync_directory(self._directory)

    def by_cid(self) -> Mapping[str, frozenset[str]]:
        """All CIDs that are pinned, each with its labels."""
        found: dict[str, set[str]] = {}
        for name in os.listdir(self._directory):
            found.setdefault(name[:CID_LENGTH], set()).add(name[CID_LENGTH + 1 :])
        return {cid: frozenset(labels) for cid, labels in sorted(found.items())}

    def _path(self, cid: str, label: str) -> Path:
        parse_cid(cid)
        return self._directory / f"{cid}.{check_label(label)}"


def check_label(label: str) -> str:
    """The same label. Raises `InputError` if it has other characters than letters, digits, `_` and `-`, or over 64."""
    if not _LABEL.fullmatch(label):
        raise InputError(f"{label[:80]!r} is no label of a pin: 1 to 64 letters, digits, _ and -")
    return label
