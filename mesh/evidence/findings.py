"""What was looked at, and what came of it."""

from __future__ import annotations

from msgspec import Struct


class Finding(Struct, frozen=True):
    """One thing that was looked at. `holds` is None where it can't be told; `detail` says for people what was found.

    `name` is machine-readable: `objective-file`, `result-file`, `finalized`, `signature`, `readable`, `statistics`,
    `closed`, `sequence`, `times`, `liability`, `agent`, `lighthouse`, `objective`, `played`.
    """

    name: str
    holds: bool | None
    detail: str


class Verdict(Struct, frozen=True):
    """All findings, in the order in which they were made."""

    findings: tuple[Finding, ...]

    @property
    def holds(self) -> bool:
        """Whether nothing was found that does not hold."""
        return all(finding.holds is not False for finding in self.findings)

    def of(self, name: str) -> Finding | None:
        """The finding of that name, if there is one."""
        return next((finding for finding in self.findings if finding.name == name), None)
