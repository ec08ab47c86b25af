"""Contracts (liabilities) whose end is waited for."""

from __future__ import annotations

import asyncio
import logging
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final, Literal

import msgspec

from mesh.agent.errors import LiabilityReverted
from mesh.agent.judged_contract import refusal
from mesh.agent.progress import Progress, followed_job, nothing, report
from mesh.content import ContentUnavailable
from mesh.errors import AiraError
from mesh.log_context import log_event
from mesh.work.notes import Reason, read_reason
from schemas import ZERO_ADDRESS
from schemas.verdicts import ValidatorReport

if TYPE_CHECKING:
    from pathlib import Path

    from mesh.agent.components import AgentComponents
    from mesh.agent.progress import OnProgress
    from mesh.agent.reports import ContractReports
    from schemas import Liability

log = logging.getLogger(__name__)

REASON_TIMEOUT: Final = 10.0
"""Seconds without a new block after which the recording of a failed job is given up, and with it the reason."""


class Outcome(msgspec.Struct, frozen=True, kw_only=True, repr_omit_defaults=True):
    """How a contract ended: `success` means that the promisor was paid; `result` is the recording's CID, or empty.

    If it failed, `reason` says why in a line of text and `code` for programs. They come from the promisor's recording,
    which may lie or be unavailable (`recording-unavailable`); without a result the code is `no-result`. If a validator
    has judged that the work does not count, they are its reason. `reports` has what its jurors reported.
    """

    success: bool
    result: str
    reason: str = ""
    code: str = ""
    reports: tuple[ValidatorReport, ...] = ()


class Contract:
    """A contract on the chain: `await contract.outcome()`, then `await contract.recording()`."""

    def __init__(
        self, liability: Liability, ended: asyncio.Future[Outcome], parts: AgentComponents, reports: ContractReports
    ) -> None:
        self.liability = liability
        """Its record, as it was when the contract was first read."""
        self._ended = ended
        self._parts = parts
        self._reports = reports
        self._failure: Reason | None = None

    def __repr__(self) -> str:
        liability, ended = self.liability, self._ended
        state = "open"
        if ended.done():
            failed = ended.cancelled() or ended.exception() is not None
            state = "reverted" if failed else "paid" if ended.result().success else "refunded"
        parties = f"promisee={liability.promisee}, promisor={liability.promisor}"
        return f"Contract({self.address}, {state}, cost={liability.cost}, {parties})"

    @property
    def address(self) -> str:
        """The contract's address (EIP-55)."""
        return self.liability.address

    async def outcome(self, *, on_progress: OnProgress = nothing) -> Outcome:
        """Wait until the contract is finalized. Cancelling the wait changes nothing.

        `on_progress` is called with what the promisor says of the job meanwhile, and with the end.

        Raises `ClosedError` if the agent ends first, and `LiabilityReverted` if a reorganisation reverted the contract
        and it was not created again by its orders' deadline.

        Of a job that failed it fetches the recording, for at most `REASON_TIMEOUT`, and reads the reason.
        """
        async with (
            self._reports.followed(self.liability, on_progress),
            followed_job(self._parts, self.liability, on_progress),
        ):
            ended = await asyncio.shield(self._ended)
            ended = msgspec.structs.replace(ended, reports=await self._last_reports())
        if not ended.success:
            if self._failure is None:
                self._failure = await self._reason(ended)
            ended = msgspec.structs.replace(ended, reason=self._failure.text, code=self._failure.code)
        kind: Literal["paid", "refunded"] = "paid" if ended.success else "refunded"
        report(on_progress, Progress(kind=kind, agent=self.liability.promisor, code=ended.code, detail=ended.reason))
        return ended

    async def reports(self) -> tuple[ValidatorReport, ...]:
        """What the jurors of its validator have reported until now, each report signed and by a juror, one of each.

        Jurors are asked for what this agent missed. Empty if the contract names no validator. Raises `ChainError`.
        """
        return await self._reports.of(self.liability)

    async def recording(self) -> Path:
        """Wait for the outcome, and fetch the result's recording, every block of it checked.

        Raises a `ContentError` if the recording is unavailable or the contract was refunded without a result.
        """
        ended = await asyncio.shield(self._ended)
        if not ended.result:
            raise ContentUnavailable("the recording", f"contract {self.address} was refunded without a result")
        return await self._fetch(ended.result, self._parts.settings.fetch_timeout)

    async def _fetch(self, cid: str, timeout: float) -> Path:
        limit = self._parts.settings.objective_expanded_limit
        return await self._parts.exchange.fetch(cid, size_limit=limit, timeout=timeout)

    async def _last_reports(self) -> tuple[ValidatorReport, ...]:
        """The reports at the end; those that are known if the node is away."""
        try:
            return await self._reports.of(self.liability)
        except AiraError as error:
            log.debug("the reports are not asked for: %s", error)
            return self._reports.known(self.liability.address)

    async def _reason(self, ended: Outcome) -> Reason:
        """Why the job failed, as its validator or its recording says."""
        refused = refusal(ended.reports)
        if not ended.result and self.liability.validator != ZERO_ADDRESS:
            return Reason("no result, or no verdict of the validator, came in time", "no-result")
        if not ended.result:
            return Reason("no result came in time", "no-result")
        if refused is not None:
            return Reason(*refused)
        try:
            timeout = min(REASON_TIMEOUT, self._parts.settings.fetch_timeout)
            return await asyncio.to_thread(read_reason, await self._fetch(ended.result, timeout))
        except AiraError as error:
            return Reason(f"the recording, which says why, is not available: {error}", "recording-unavailable")


@dataclass
class _WatchedContract:
    """A contract whose end somebody may wait for."""

    ended: asyncio.Future[Outcome]
    order: str = ""
    """The order of ours (hash) that it was created from, if any, and what those hold who waited for it."""
    contract: Contract | None = None
    reverted_until: int | None = None
    """While a reorganisation has reverted it: the block by which it must be created again."""


class WatchedContracts:
    """The contracts whose end is waited for, by address."""

    def __init__(self, parts: AgentComponents, reports: ContractReports) -> None:
        self._parts = parts
        self._reports = reports
        self._watched: dict[str, _WatchedContract] = {}

    def __len__(self) -> int:
        return len(self._watched)

    def __contains__(self, address: str) -> bool:
        return address in self._watched

    async def read(self, address: str) -> Contract:
        """The contract at `address` (or name), read from the chain. Raises `NotALiability`."""
        address = await self._parts.chain.names.address(address)
        is_new = address not in self._watched
        self._watch(address)  # before it is read: it may end in between
        try:
            return self.watch(await self._parts.chain.liabilities.get(address))
        except BaseException:
            if is_new:
                self._watched.pop(address, None)
            raise

    def watch(self, liability: Liability, *, order: str = "") -> Contract:
        """The contract of `liability`, which was created from our `order` (lasting hash), if from any."""
        watched = self._watch(liability.address)
        contract = Contract(liability, watched.ended, self._parts, self._reports)
        self._reports.follow(liability)
        if order:
            watched.order, watched.contract = order, contract
        if liability.is_finalized:
            self.finalized(liability.address, Outcome(success=liability.is_success, result=liability.result))
        return contract

    def created(self, liability: Liability, order: str) -> Contract | None:
        """The contract exists, perhaps again. Returns the one that was watched before for our `order` (lasting hash).

        After a reorganisation the contract of an order may be at another address.
        """
        if (watched := self._watched.get(liability.address)) is not None:
            watched.reverted_until = None
        self._reports.follow(liability)
        again = next((one for one in self._watched.values() if order and one.order == order), None)
        if again is None or again.contract is None:
            return None
        again.reverted_until = None
        self._watched[liability.address] = self._watched.pop(again.contract.address)
        again.contract.liability = liability
        return again.contract

    def reverted(self, address: str, deadline: int) -> None:
        """A reorganisation reverted the contract at `address`, whose orders are valid until block `deadline`."""
        if address in self._watched:
            self._watched[address].reverted_until = deadline

    def finalized(self, address: str, outcome: Outcome) -> None:
        """The contract at `address` has ended."""
        watched = self._watched.pop(address, None)
        if watched is not None and not watched.ended.done():
            facts = log_event("contract-ended", success=outcome.success, result=outcome.result)
            log.info("the contract has ended, %s", "paid" if outcome.success else "refunded", extra=facts)
            watched.ended.set_result(outcome)

    def expire(self, block: int) -> None:
        """The chain has `block`: reverted contracts whose orders' deadline has passed are given up."""
        for address, watched in list(self._watched.items()):
            if watched.reverted_until is not None and watched.reverted_until <= block:
                del self._watched[address]
                fail_future(watched.ended, LiabilityReverted(address, watched.reverted_until))

    def fail(self, error: Exception) -> None:
        """Fail everything that is waited for."""
        for watched in self._watched.values():
            fail_future(watched.ended, error)

    def _watch(self, address: str) -> _WatchedContract:
        if address not in self._watched:
            self._watched[address] = _WatchedContract(asyncio.get_running_loop().create_future())
        return self._watched[address]


def fail_future(future: asyncio.Future[Any] | None, error: Exception) -> None:
    """Fail what somebody may be waiting for."""
    if future is not None and not future.done():
        future.set_exception(error)
        future.exception()  # marks it as retrieved: perhaps nobody waits
