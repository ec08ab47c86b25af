"""Running the checks of a context in this process, and their results."""

from __future__ import annotations

from collections import defaultdict
from contextlib import aclosing
from typing import TYPE_CHECKING, Any

from mesh.ops.doctor import Check, CheckResult, CheckStatus, DoctorContext, checks_for, run_checks
from mesh.ops.doctor.checks import with_identity
from mesh.settings import Settings

if TYPE_CHECKING:
    from collections.abc import Sequence

    from mesh.network import Endpoints
    from mesh.ops.identity.certificates import MemberFolder
    from tests.support.sites import Site

SECONDS = 60.0


class Found(defaultdict[str, list[CheckResult]]):
    """The results by the names of the checks, without skipped ones."""

    def one(self, name: str) -> CheckResult:
        """The result of the only check of that name."""
        (result,) = self[name]
        return result

    @property
    def failed(self) -> list[str]:
        """The names of the checks that failed."""
        return [name for name, results in self.items() for result in results if not result.ok]

    def cause(self, name: str) -> CheckResult:
        """The failed result of the check of that name, which must be the only failed one."""
        assert self.failed == [name], dict(self)
        (result,) = [result for result in self[name] if not result.ok]
        assert result.status is CheckStatus.FAIL
        assert result.hint
        return result


async def examined(context: DoctorContext, *, seconds: float = SECONDS) -> Found:
    """All checks of a context made."""
    async with checks_for(with_identity(context)) as checks:
        return await made(checks, seconds=seconds)


async def made(checks: Sequence[Check], *, seconds: float = SECONDS) -> Found:
    """These checks made."""
    found = Found(list)
    async with aclosing(run_checks(checks, seconds=seconds)) as examining:
        async for checked in examining:
            if checked.result is not None:
                found[checked.name].append(checked.result)
    return found


def settings_of(endpoints: Endpoints, **options: Any) -> Settings:
    """The settings of a client of these endpoints, with their certificate."""
    tls = endpoints.tls
    files: dict[str, Any] = {} if tls is None else {"tls_ca": str(tls.ca)}
    if tls is not None and tls.pair is not None:
        files |= {"tls_certificate": str(tls.certificate), "tls_key": str(tls.key)}
    return Settings(connect=endpoints.connect, **files, **options)


def context_of_member(site: Site, folder: MemberFolder, **options: str) -> DoctorContext:
    """The context of an operator with the identity in a folder, for checks of the network."""
    return DoctorContext(settings=settings_of(site.client(folder), **options), requested_role="operator")
