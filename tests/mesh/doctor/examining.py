"""A case examined in this process, and what was found."""

from __future__ import annotations

from collections import defaultdict
from contextlib import aclosing
from typing import TYPE_CHECKING, Any

from mesh.doctor import Case, Check, Finding, Verdict, checks_for, examine
from mesh.doctor.case import examined_as
from mesh.settings import Settings

if TYPE_CHECKING:
    from collections.abc import Sequence

    from mesh.identity.folders import MemberFolder
    from mesh.network import Endpoints
    from tests.support.sites import Site

SECONDS = 60.0


class Found(defaultdict[str, list[Finding]]):
    """What was found, by the names of the checks; those that were left out are not in it."""

    def one(self, name: str) -> Finding:
        """What the only check of that name found."""
        (finding,) = self[name]
        return finding

    @property
    def failed(self) -> list[str]:
        """The names of the checks that failed."""
        return [name for name, findings in self.items() for finding in findings if not finding.ok]

    def cause(self, name: str) -> str:
        """What the only check that failed found, which is that one, and which says what to do."""
        assert self.failed == [name], dict(self)
        (finding,) = [finding for finding in self[name] if not finding.ok]
        assert finding.verdict is Verdict.FAIL
        assert finding.do
        return f"{finding.found}; {finding.do}"


async def examined(case: Case, *, seconds: float = SECONDS) -> Found:
    """All checks of a case made."""
    async with checks_for(examined_as(case)) as checks:
        return await made(checks, seconds=seconds)


async def made(checks: Sequence[Check], *, seconds: float = SECONDS) -> Found:
    """These checks made."""
    found = Found(list)
    async with aclosing(examine(checks, seconds=seconds)) as examining:
        async for checked in examining:
            if checked.finding is not None:
                found[checked.name].append(checked.finding)
    return found


def settings_of(endpoints: Endpoints, **options: Any) -> Settings:
    """The settings of somebody who connects there, as the holder of that certificate."""
    tls = endpoints.tls
    files: dict[str, Any] = {} if tls is None else {"tls_ca": str(tls.ca)}
    if tls is not None and tls.pair is not None:
        files |= {"tls_certificate": str(tls.certificate), "tls_key": str(tls.key)}
    return Settings(connect=endpoints.connect, **files, **options)


def case_of(site: Site, folder: MemberFolder, **options: str) -> Case:
    """An operator's case, of whom only the network matters, with the identity in a folder."""
    return Case(settings=settings_of(site.client(folder), **options), asked_role="operator")
