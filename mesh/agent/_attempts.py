"""Second chances: a job that failed is ordered again, from another robot, with the money that came back.

All attempts are under one number, that of the first order, and under its deadline. A robot that does not begin in time
is stopped, which counts as a failure. No attempt follows one that was paid, whose cost has not come back, or that its
customer has stopped.
"""

from __future__ import annotations

import asyncio
import logging
import math
from functools import partial
from typing import TYPE_CHECKING, Any, Final, TypeVar

from msgspec.structs import replace

from mesh.agent.contracts import ENDED, Progress, fail_future, followed_job, report, request_stop
from mesh.agent.jobs import STOPPED
from mesh.agent.orders import OrderClosed, OrderExpired
from mesh.base.log_context import liability_context, log_event
from mesh.errors import AiraError, InputError

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Collection, Coroutine

    from mesh.agent.components import AgentComponents
    from mesh.agent.contracts import Contract, OnProgress, Outcome
    from mesh.agent.trade import Order

log = logging.getLogger(__name__)

T = TypeVar("T")

MOST_RETRIES: Final = 10
"""Most further attempts at a job."""


def check_attempts(retry: int, start_within: float | None, *, robot: str) -> None:
    """Raise `InputError` for what can't be: `robot` is the one that was named, if any."""
    if not 0 <= retry <= MOST_RETRIES:
        hint = f"give a number from 0 to {MOST_RETRIES}"
        raise InputError(f"a job can't be ordered again {retry} times", hint=hint, code="invalid-retry")
    if start_within is not None and not (0 < start_within < math.inf):
        hint = "give a number of seconds above 0"
        raise InputError(f"no job begins within {start_within:g} seconds", hint=hint, code="invalid-start-within")
    if retry and robot:
        raise InputError(
            f"the job is for {robot} alone, so no other robot can do it when that fails",
            hint="choose by `cheapest` or `first` instead of a name, or don't retry",
            code="invalid-retry",
        )


class Attempts:
    """The attempts at one job, for `run` with the first contract in a task.

    `order_again` orders from another robot than those in `besides`, valid for `lifetime` blocks, `retry` times at most.
    """

    def __init__(
        self,
        parts: AgentComponents,
        order_again: Callable[..., Awaitable[Order]],
        *,
        retry: int,
        start_within: float | None,
    ) -> None:
        self._parts = parts
        self._order_again = order_again
        self._deadline = 0
        self._total = retry + 1
        self._start_within = start_within
        self.number = ""
        self.order = ""
        self._called_off = asyncio.Event()
        """Set when the customer has stopped the job: then there is no other attempt."""
        self._ordering: asyncio.Task[Contract | None] | None = None
        """While there is no contract, because the next one is being ordered."""
        self._ended: asyncio.Future[Outcome] = asyncio.get_running_loop().create_future()
        self._listeners: list[OnProgress] = []
        self._said: dict[str, Progress] = {}
        """The last progress of each kind since the latest contract, for those who listen later."""

    def ordered(self, order: str, deadline: int) -> None:
        """The first order, which is about to be posted: its hash, and the block until which it is valid."""
        self.number, self._deadline = order[:16], deadline

    async def outcome(self, on_progress: OnProgress) -> Outcome:
        """Wait for the end of the last attempt. Raises as `Contract.outcome`."""
        for said in [*self._said.values()]:
            report(on_progress, said)
        self._listeners.append(on_progress)
        try:
            return await asyncio.shield(self._ended)
        finally:
            self._listeners.remove(on_progress)

    async def call_off(self) -> None:
        """Order no more. What is being ordered is called off, unless it has just become a contract."""
        self._called_off.set()
        if self._ordering is not None:
            await asyncio.wait([self._ordering])

    async def run(self, first: Contract) -> None:
        """See a contract to its end, and those that follow it."""
        contract = first
        earlier: tuple[Outcome, ...] = ()
        try:
            for number in range(2, self._total + 2):
                ended, is_customers = await self._end_of(contract)
                following = None
                if not (ended.success or is_customers or number > self._total):
                    ordering = self._next(contract, (*earlier, ended), number)
                    self._ordering = asyncio.create_task(ordering, name=f"attempt {number} of {self.number}")
                    following, self._ordering = await self._ordering, None
                if following is None:
                    self._ended.set_result(replace(ended, earlier=earlier))
                    return
                contract, earlier = following, (*earlier, ended)
        except AiraError as error:
            fail_future(self._ended, error)
        finally:
            fail_future(self._ended, ENDED())

    async def _end_of(self, contract: Contract) -> tuple[Outcome, bool]:
        """How a contract ends, and whether its customer has ended it."""
        late = asyncio.create_task(self._is_late(contract), name=f"start of {contract.address}")
        try:
            ended = await contract.end(self._report)
        finally:
            late.cancel()
            (is_late,) = await asyncio.gather(late, return_exceptions=True)
        return ended, self._called_off.is_set() or (ended.code == STOPPED and is_late is not True)

    async def _is_late(self, contract: Contract) -> bool:
        """Stop a job if the robot does not say in time that it has begun. Returns whether it was late."""
        if self._start_within is None:
            return False
        begun, liability = asyncio.Event(), contract.liability

        def seen(progress: Progress) -> None:
            if progress.kind in ("playing", "result"):
                begun.set()

        async with followed_job(self._parts, liability, seen):
            try:
                async with asyncio.timeout(self._start_within):
                    await begun.wait()
                return False
            except TimeoutError:
                seconds = f"{self._start_within:g}"
        self._report(Progress(kind="late", agent=liability.promisor, detail=seconds))
        try:
            parts, why = self._parts, f"it did not begin within {seconds} s"
            await asyncio.shield(request_stop(parts.network.session, parts.signer, liability, why))
        except AiraError as error:  # then it is done after all, or refunded at its deadline
            facts = log_event("late-not-stopped", robot=liability.promisor, code=error.code)
            log.warning("%s has not begun, and does not stop: %s", liability.promisor, error, extra=facts)
        except asyncio.CancelledError:
            pass  # the contract has ended before the robot's answer came
        return True

    async def _next(self, contract: Contract, earlier: tuple[Outcome, ...], number: int) -> Contract | None:
        """The contract of attempt `number`; None if there is no such attempt, and those who wait are told why."""
        failed, chain = earlier[-1], self._parts.chain
        with liability_context(contract.address):
            try:
                await self._require_returned(contract)
                asking = partial(self._order, {one.robot for one in earlier})
                order = await self._unless_called_off(chain.retrying(asking, outages=self._parts.outages))
                if order is None:
                    return None
                facts = log_event("ordered-again", number=self.number, attempt=number, order=order.hash)
                log.info("ordered again, attempt %d of %d", number, self._total, extra=facts)
                said = {"agent": failed.robot, "code": failed.code, "detail": failed.reason}
                self._said.clear()
                self.order = order.hash
                self._report(Progress(kind="again", position=number, total=self._total, **said))
                following = await self._unless_called_off(order.contract(on_progress=self._report, wait=False))
                if following is None and not await self._call_off(order):
                    following = await order.contract()
            except AiraError as error:
                facts = log_event("not-ordered-again", number=self.number, code=error.code)
                log.info("the job is not ordered again: %s", error, extra=facts)
                self._report(Progress(kind="given-up", agent=failed.robot, code=error.code, detail=str(error)))
                return None
            finally:
                self.order = ""
        if following is not None:
            following.attempts, contract.following = self, following
        return following

    async def _unless_called_off(self, doing: Coroutine[Any, Any, T]) -> T | None:
        """What `doing` returns; None if the customer stops the job meanwhile."""
        task, called_off = asyncio.create_task(doing), asyncio.create_task(self._called_off.wait())
        try:
            await asyncio.wait((task, called_off), return_when=asyncio.FIRST_COMPLETED)
        finally:
            called_off.cancel()
            if not task.done():
                task.cancel()
                await asyncio.wait([task])
        return None if task.cancelled() else task.result()

    async def _call_off(self, order: Order) -> bool:
        """Call an order off. False if it has become a contract."""
        try:
            await order.call_off()
        except OrderClosed:
            return False
        return True

    async def _order(self, besides: Collection[str]) -> Order:
        left = self._deadline - await self._parts.chain.contract_block()
        if left <= 0:
            raise OrderExpired(self.number, self._deadline)
        lifetime = min(left, self._parts.settings.deadline_limit)  # the default lifetime may be above it
        return await self._order_again(besides=besides, lifetime=lifetime)

    async def _require_returned(self, contract: Contract) -> None:
        """Raise unless the cost of a contract that has failed has come back."""
        chain, address = self._parts.chain, contract.address

        async def owed() -> int:
            return await chain.liabilities.owed_after(await chain.liabilities.get(address))

        if await chain.retrying(owed, outages=self._parts.outages):
            hint = f"`aira liability claim {address}` takes it"
            raise AiraError("the token has refused to return the cost", hint=hint, code="cost-not-returned")

    def _report(self, progress: Progress) -> None:
        self._said[progress.kind] = progress
        for listener in [*self._listeners]:
            report(listener, progress)
