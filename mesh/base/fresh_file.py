"""Files that an operator may change at any time, such as the one that says who is shut out."""

from __future__ import annotations

import logging
import threading
from pathlib import Path
from typing import TYPE_CHECKING, Final, Generic, TypeVar

from mesh.base.clock import SYSTEM_CLOCK
from mesh.base.log_context import log_event
from mesh.errors import AiraError, ConfigurationError
from schemas import InputError, parse_address
from schemas.decoding import InvalidData, text_of

if TYPE_CHECKING:
    from collections.abc import Callable, Container

    from mesh.base.clock import Clock

T = TypeVar("T")

log = logging.getLogger(__name__)

CHECK_INTERVAL: Final = 1.0
"""Seconds between two looks at whether a file has changed."""
SIZE_LIMIT: Final = 4 * 1024 * 1024
"""The largest blocklist, in bytes: about 90,000 addresses."""


class FreshFile(Generic[T]):
    """What `read` makes of a file; it is read again within a second of a change. Thread-safe.

    After a change that can't be read, what was read before stays: the error is passed to `on_error`, what is new to
    `on_change`. Raises the errors of `read` when it is created.
    """

    def __init__(
        self,
        path: Path,
        read: Callable[[Path], T],
        *,
        on_error: Callable[[AiraError], None],
        on_change: Callable[[T], None] = lambda new: None,
        clock: Clock = SYSTEM_CLOCK,
    ) -> None:
        self._path = path
        self._read_file = read
        self._on_error = on_error
        self._on_change = on_change
        self._clock = clock
        self._lock = threading.Lock()
        self._version = self._stat()
        self._content = read(path)
        self._checked = clock.monotonic()

    @property
    def content(self) -> T:
        """What was read last; the same object as long as nothing has changed."""
        if self._clock.monotonic() - self._checked >= CHECK_INTERVAL:
            self._check()
        return self._content

    def _check(self) -> None:
        with self._lock:
            self._checked = self._clock.monotonic()
            version = self._stat()
            if version == self._version:
                return
            self._version = version
            try:
                self._content = self._read_file(self._path)
            except AiraError as error:
                self._on_error(error)
            else:
                self._on_change(self._content)

    def _stat(self) -> tuple[int, int, int] | None:
        try:
            found = self._path.stat()
        except OSError:
            return None  # reading it says why
        return found.st_mtime_ns, found.st_size, found.st_ino


class Blocklist:
    """The lines of the file `path`, each as `parse` writes it; `#` begins a comment.

    By default they are addresses, and `"0x…" in blocklist` (EIP-55) asks for one. The file is read again within a
    second of a change. A change that can't be read is logged, and those from before stay blocked. Thread-safe. Raises
    `ConfigurationError` when it is created from such a file.
    """

    def __init__(self, path: Path, *, parse: Callable[[str], str] = parse_address, clock: Clock = SYSTEM_CLOCK) -> None:
        self._path = path
        self._parse = parse
        self._file = FreshFile(path, self._read, on_error=_log_error, on_change=self._log_change, clock=clock)

    def __contains__(self, entry: object) -> bool:
        return entry in self.entries

    @property
    def entries(self) -> frozenset[str]:
        """All of them; the same object as long as nothing has changed."""
        return self._file.content

    def _log_change(self, entries: frozenset[str]) -> None:
        facts = log_event("blocklist-read", blocked=len(entries), path=str(self._path))
        log.info("%d are blocked by %s", len(entries), self._path, extra=facts)

    def _read(self, path: Path) -> frozenset[str]:
        try:
            with path.open("rb") as file:
                data = file.read(SIZE_LIMIT + 1)
            lines = text_of(data).splitlines()
        except (OSError, InvalidData) as error:
            reason = error.strerror if isinstance(error, OSError) else error
            raise _unusable(f"can't read the blocklist {path}: {reason}", "name a file, which may be empty") from None
        if len(data) > SIZE_LIMIT:
            raise _unusable(f"the blocklist {path} is larger than {SIZE_LIMIT} bytes", "")
        return frozenset(filter(None, map(self._entry, range(1, len(lines) + 1), lines)))

    def _entry(self, number: int, line: str) -> str:
        text = line.partition("#")[0].strip()
        try:
            return self._parse(text) if text else ""
        except (InputError, ValueError) as error:
            why = f"line {number} of the blocklist {self._path} can't be used: {error}"
            raise _unusable(why, "write one entry a line") from None


def _unusable(why: str, hint: str) -> ConfigurationError:
    return ConfigurationError(why, hint=hint, code="blocklist-unusable")


def _log_error(error: AiraError) -> None:
    log.warning("the blocklist stays as it was: %s", error, extra=log_event("blocklist-unusable"))


def blocklist_at(path: str) -> Container[str]:
    """The blocklist in the file that a setting names; nobody is blocked if it is empty. Raises `ConfigurationError`."""
    return Blocklist(Path(path).expanduser()) if path else frozenset()
