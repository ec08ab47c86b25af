"""Logging of outages: once when one begins and once when it ends, however many attempts fail in between."""

from __future__ import annotations

from typing import TYPE_CHECKING

from mesh.base.log_context import log_event

if TYPE_CHECKING:
    import logging

    from mesh.errors import AiraError


class OutageLog:
    """Outages of one dependency, logged to `log` as the events `{name}-outage` and `{name}-recovered`.

    Two errors are the same outage when they have the same code and, where they have one, the same `reason`.
    """

    def __init__(self, log: logging.Logger, name: str) -> None:
        self._log = log
        self._name = name
        self._current: set[tuple[str, object]] = set()

    def failed(self, error: AiraError, consequence: str) -> None:
        """Log `error`, its hint and its `consequence`, unless the same outage was logged already."""
        kind = error.code, getattr(error, "reason", None)
        if kind not in self._current:
            self._current.add(kind)
            known = log_event(f"{self._name}-outage", code=error.code)
            self._log.warning("%s: %s%s", consequence, error, f"; {error.hint}" if error.hint else "", extra=known)

    @property
    def is_down(self) -> bool:
        """Whether an outage lasts."""
        return bool(self._current)

    def recovered(self, message: str) -> None:
        """Log `message` if an outage lasted until now."""
        if self._current:
            self._current.clear()
            self._log.info("%s", message, extra=log_event(f"{self._name}-recovered"))
