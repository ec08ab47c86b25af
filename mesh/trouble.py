"""Troubles that last: said once when they begin and once when they are over, however often they are met in between."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import logging

    from mesh.errors import AiraError


class Trouble:
    """What stands in the way of something that is tried again and again. `log` is whose words they are.

    Two errors are the same trouble when they are of one class and, where they have one, of one `reason`.
    """

    def __init__(self, log: logging.Logger) -> None:
        self._log = log
        self._standing: set[tuple[type[AiraError], object]] = set()

    def met(self, error: AiraError, words: str) -> None:
        """Say what happens because of `error` (`words`), and what to do about it, unless that was said already."""
        kind = type(error), getattr(error, "reason", None)
        if kind not in self._standing:
            self._standing.add(kind)
            self._log.warning("%s: %s%s", words, error, f"; {error.hint}" if error.hint else "")

    @property
    def stands(self) -> bool:
        """Whether something stands in the way now."""
        return bool(self._standing)

    def over(self, words: str) -> None:
        """Say that it goes on (`words`), if something stood in the way."""
        if self._standing:
            self._standing.clear()
            self._log.info("%s", words)
