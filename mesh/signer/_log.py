"""The log of a signer: what programs asked for, what was allowed and refused, what people said, and what came of it.

Each entry is a line of JSON with a number, the hash of the entry before and the account's signature. The database has
the last entry and the number of the first one that is kept, so an entry that was changed, removed, added, or cut off at
either end is found. An entry is in the database before it is in the file: one that a crash keeps from the file is
written when the log is opened again.
"""

from __future__ import annotations

import os
import re
from datetime import UTC, datetime
from itertools import pairwise
from typing import TYPE_CHECKING, Any, Final

import msgspec

from mesh.base.private_files import make_private_folder, open_private, sync_directory, sync_file
from mesh.signer._budget import Head
from schemas.address import keccak256
from schemas.decoding import InvalidData, decode_json
from schemas.errors import AiraError
from schemas.signing import recover

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path

    from mesh.signer._budget import Budget
    from schemas import Signer

FILE_BYTES: Final = 4 << 20
"""Bytes after which another file is begun."""
FILES: Final = 16
"""Files that are kept: the oldest goes when there is one more."""
_NAME: Final = re.compile(r"log-(\d{12})\.jsonl")
_LONGEST_LINE: Final = 1 << 16


class SignedEntry(msgspec.Struct, frozen=True, kw_only=True):
    """An entry: `time` is Unix time, `previous` the hash of the entry before. The `signature` is over `hash`."""

    number: int
    time: float
    event: str
    facts: dict[str, Any]
    previous: str
    signature: str = ""

    @property
    def digest(self) -> bytes:
        """What is signed: the hash of all but the signature."""
        return keccak256(b"aira log\0" + msgspec.json.encode(msgspec.structs.replace(self, signature="")))

    @property
    def hash(self) -> str:
        """The digest, 64 hexadecimal digits."""
        return self.digest.hex()


class SignerLog:
    """The log in a folder, signed by an account. `budget` is the open database that has its head."""

    def __init__(
        self,
        folder: Path,
        signer: Signer,
        budget: Budget,
        *,
        file_bytes: int = FILE_BYTES,
        files: int = FILES,
    ) -> None:
        self.folder = folder
        self._signer = signer
        self._budget = budget
        self._file_bytes = file_bytes
        self._files = files

    def open(self) -> None:
        """Write the last entry to its file if a crash kept it from that. Raises `AiraError`, `OSError`."""
        make_private_folder(self.folder)
        head = self._budget.log_head()
        if not head.last:
            return
        path = self._paths()[-1] if self._paths() else self._path_of(head.last)
        data = path.read_bytes() if path.exists() else b""
        whole, torn = data.rpartition(b"\n")[0], data.rpartition(b"\n")[2]
        last = whole.rpartition(b"\n")[2].decode(errors="replace")
        if last == head.line and not torn:
            return
        number = _number_in(last)
        if (number == head.last - 1 or (not whole and head.last == head.first)) and head.line.encode().startswith(torn):
            with open(path, "wb" if not whole else "r+b", opener=open_private) as file:
                file.truncate(len(data) - len(torn))
                file.seek(0, os.SEEK_END)
                file.write(head.line.encode() + b"\n")
            sync_file(path)
            sync_directory(self.folder)
            return
        raise AiraError(
            f"the signer's log was changed: entry {head.last} is not the last one",
            hint="`aira mcp log --verify` says where; keep the folder for inquiry, and begin with another --data-dir",
            code="log-unusable",
        )

    def add(self, event: str, **facts: Any) -> SignedEntry:
        """Add an entry. It survives a crash of the program at once, and one of the machine after `Budget.sync`.

        Raises `OSError`, `sqlite3.Error`.
        """
        head = self._budget.log_head()
        entry = SignedEntry(number=head.last + 1, time=self._budget.now(), event=event, facts=facts, previous=head.hash)
        entry = msgspec.structs.replace(entry, signature=self._signer.sign_hash(entry.digest).hex())
        line = msgspec.json.encode(entry)
        path, first, before = self._place(head)
        self._budget.keep_log_head(Head(first, before, entry.number, entry.hash, line.decode()))
        with open(path, "ab", opener=open_private) as file:
            file.write(line + b"\n")
        return entry

    def entries(self, first: int | None = None, limit: int = 100) -> list[SignedEntry]:
        """Up to `limit` entries from a number on, or the latest. Blocks on the disk. Raises `AiraError`."""
        head = self._budget.log_head()
        start = max(head.first, head.last - limit + 1 if first is None else first)
        found: list[SignedEntry] = []
        paths = self._paths()
        for path, following in zip(paths, [*paths[1:], None], strict=True):
            if following is not None and _first_of(following) <= start:
                continue
            for line in _lines(path):
                entry = _decoded(line)
                if entry is None:
                    hint = "`aira mcp log --verify` says where"
                    raise AiraError("the signer's log was changed", hint=hint, code="log-unusable")
                if entry.number >= start:
                    found.append(entry)
                if len(found) == limit:
                    return found
        return found

    def _place(self, head: Head) -> tuple[Path, int, str]:
        """The file of the next entry; and the first entry that is kept, and the hash before it."""
        paths = self._paths()
        if paths and paths[-1].stat().st_size < self._file_bytes:
            return paths[-1], head.first, head.before
        path = self._path_of(head.last + 1)
        first, before = head.first, head.before
        for old, following in pairwise(paths):
            if len(paths) < self._files:
                break
            if (entry := next((_decoded(line) for line in _lines(following)), None)) is not None:
                first, before = entry.number, entry.previous
            self._budget.keep_log_head(Head(first, before, head.last, head.hash, head.line))
            old.unlink()
            break
        return path, first, before

    def _paths(self) -> list[Path]:
        return log_files(self.folder)

    def _path_of(self, number: int) -> Path:
        return self.folder / f"log-{number:012d}.jsonl"


def log_files(folder: Path) -> list[Path]:
    """The files of a log, the oldest first."""
    return sorted(path for path in folder.iterdir() if _NAME.fullmatch(path.name)) if folder.is_dir() else []


def verify_log(folder: Path, signer: str, head: Head, *, latest: Callable[[], int] | None = None) -> str:
    """What is wrong with the log of an account (address) whose head is known; an empty text if nothing is.

    The log may grow meanwhile if `latest` says which entry is the last one by then. Blocks on the disk, and takes about
    a tenth of a millisecond an entry.
    """
    number, previous = head.first, head.before
    for path in log_files(folder):
        for line in _lines(path):
            entry = _decoded(line)
            if entry is None:
                return f"entry {number} is unreadable ({path.name})"
            if entry.number != number:
                return f"entry {number} is missing: entry {entry.number} follows {number - 1}"
            if entry.previous != previous:
                return f"entry {number} does not follow entry {number - 1}: one of them was changed"
            try:
                by = recover(entry.digest, bytes.fromhex(entry.signature))
            except (AiraError, ValueError):
                by = ""
            if by != signer:
                return f"entry {number} was changed: it is not signed by {signer}"
            number, previous = number + 1, entry.hash
            if entry.number == head.last and previous != head.hash:
                return f"entry {head.last} is another one than the database says"
    last = head.last if latest is None else latest()
    if not head.last <= number - 1 <= last:
        return f"the log ends with entry {number - 1}, and entry {last} was the last one"
    return ""


def time_text(unix: float) -> str:
    """A time as ISO 8601 in UTC."""
    return datetime.fromtimestamp(unix, UTC).isoformat(timespec="milliseconds").replace("+00:00", "Z")


def _lines(path: Path) -> Iterator[bytes]:
    with path.open("rb") as file:
        while line := file.readline(_LONGEST_LINE + 2):
            yield line.removesuffix(b"\n")


def _decoded(line: bytes) -> SignedEntry | None:
    """The entry in a line; None for what is none, or written in another way than it is."""
    try:
        entry = decode_json(line, SignedEntry)
    except InvalidData:
        return None
    return entry if msgspec.json.encode(entry) == line else None


def _number_in(line: str) -> int:
    entry = _decoded(line.encode()) if line else None
    return 0 if entry is None else entry.number


def _first_of(path: Path) -> int:
    found = _NAME.fullmatch(path.name)
    assert found is not None
    return int(found[1])
