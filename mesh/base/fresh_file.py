"""A file that an operator may change at any time."""

from __future__ import annotations

import threading
from typing import TYPE_CHECKING, Final, Generic, TypeVar

from mesh.base.clock import SYSTEM_CLOCK
from mesh.errors import AiraError

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from mesh.base.clock import Clock

T = TypeVar("T")

CHECK_INTERVAL: Final = 1.0
"""Seconds between two looks at whether a file has changed."""


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
