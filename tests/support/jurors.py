"""A juror for tests of what the parties see: real keys and signed records over a real router, but no judgement.

`async with Juror(place, role) as juror`: it answers queries for its announcement and for its reports.
"""

from __future__ import annotations

import time
from contextlib import AsyncExitStack
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Self

from mesh.network import Endpoints, Network
from schemas import PresenceKey, ReportKey, Signer, ValidatorKey
from schemas.verdicts import PolicyNote, ReportFinding, ValidatorAnnouncement, ValidatorReport

if TYPE_CHECKING:
    from mesh.agent.contracts import Contract
    from schemas import Liability

COMPLETE = PolicyNote(name="complete", description="everything that was commanded was played and recorded")
MISSING = ReportFinding(policy="complete", code="missing-messages", holds=False, detail="2 of 3 messages are missing")


@dataclass(kw_only=True)
class Juror:
    """A juror of `validator` (address; by default the signer's own, as in generation 3) on a router."""

    endpoint: str
    lighthouse: str
    signer: Signer
    validator: str = ""
    fee: int = 100
    title: str = "Lamp inspectors"
    policies: tuple[PolicyNote, ...] = (COMPLETE,)
    quorum: int = 1
    jurors: int = 1
    made_at: float = 0.0
    """Seconds before now."""
    served: list[ValidatorReport] = field(default_factory=list)
    """The reports with which it answers queries."""

    async def __aenter__(self) -> Self:
        self.validator = self.validator or self.signer.address
        self._stack = AsyncExitStack()
        self._session = (await self._stack.enter_async_context(Network(Endpoints(connect=(self.endpoint,))))).session
        lighthouse = self.lighthouse.lower()
        key = str(ValidatorKey(lighthouse, self.validator))
        presence = str(PresenceKey(lighthouse, "validator", self.signer.address))
        self._announcing: Any = self._session.declare_queryable(key, self._announce)
        self._reporting: Any = self._session.declare_queryable(f"aira/{lighthouse}/report/*", self._answer)
        # Last: who sees it present gets its answers.
        self._present: Any = self._session.liveliness().declare_token(presence)
        return self

    async def __aexit__(self, *exc_info: object) -> None:
        await self._stack.aclose()

    def announcement(self, **fields: Any) -> ValidatorAnnouncement:
        return ValidatorAnnouncement(
            **{
                "validator": self.validator,
                "juror": self.signer.address,
                "title": self.title,
                "policies": self.policies,
                "fee": self.fee,
                "quorum": self.quorum,
                "jurors": self.jurors,
                "made_at": int(time.time() - self.made_at),
                **fields,
            }
        )

    def report(self, liability: Liability, result: str, *, success: bool, **fields: Any) -> ValidatorReport:
        """Its signed report on a liability whose promisor claims success."""
        report = ValidatorReport(
            **{
                "liability": liability.address,
                "objective": liability.objective,
                "result": result,
                "validator": self.validator,
                "juror": self.signer.address,
                "claimed": True,
                "success": success,
                "findings": () if success else (MISSING,),
                "judged_at": int(time.time()),
                **fields,
            }
        )
        return report.signed_by(self.signer)

    def publish(self, report: ValidatorReport, *parties: str) -> None:
        """Put a report for these parties, and answer queries with it from now on."""
        self.served.append(report)
        for party in parties:
            self._session.put(str(ReportKey(self.lighthouse.lower(), party)), report.encode())

    def judge(self, contract: Contract, result: str, *, success: bool) -> ValidatorReport:
        """Report to both parties of a contract."""
        liability = contract.liability
        report = self.report(liability, result, success=success)
        self.publish(report, liability.promisee, liability.promisor)
        return report

    def _announce(self, query: Any) -> None:
        query.reply(str(query.key_expr), self.announcement().signed_by(self.signer).encode())

    def _answer(self, query: Any) -> None:
        for report in self.served:
            if query.parameters.get("liability") == report.liability.lower():
                query.reply(str(query.key_expr), report.encode())
