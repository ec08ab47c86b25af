"""What a check has found. Pure."""

from __future__ import annotations

from enum import Enum
from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from mesh.errors import AiraError


class Verdict(Enum):
    """How it is."""

    OK = "ok"
    """As it should be."""
    WARN = "warn"
    """It works now; something is to be done some day, or for some uses."""
    FAIL = "FAIL"
    """It does not work."""


class Finding(NamedTuple):
    """What is the case, in a line, and what to do about it: nothing where all is well."""

    verdict: Verdict
    found: str
    do: str = ""

    @property
    def ok(self) -> bool:
        """Whether it works."""
        return self.verdict is not Verdict.FAIL


def sound(found: str) -> Finding:
    """All is well."""
    return Finding(Verdict.OK, found)


def doubtful(found: str, *, do: str) -> Finding:
    """It works now."""
    return Finding(Verdict.WARN, found, do)


def broken(found: str, *, do: str) -> Finding:
    """It does not work."""
    return Finding(Verdict.FAIL, found, do)


def of_error(error: AiraError) -> Finding:
    """What an error says, as something that does not work."""
    return broken(str(error), do=error.hint or "see docs/deploy.md; `aira settings` shows the settings in force")
