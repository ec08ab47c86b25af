"""Finalizing liabilities by results: the promisor's own, or those of the jurors of a validator.

A validated liability needs the same result of as many jurors as are its validator's quorum. They are gathered here, and
stay under settlement until the liability has ended and a reorganisation can't take that back. A juror sends its result
again until then, so nothing is kept on disk, and a result that is dropped here comes again.
"""

from __future__ import annotations

import logging
from functools import partial
from typing import TYPE_CHECKING, Any, Final

from mesh.chain import NoContracts, NodeUnreachable, NotOffered, RequestRefused, Reverted
from mesh.clock import SYSTEM_CLOCK
from mesh.flood import BoundedDict, Rate, RateLimiter
from mesh.log_context import liability_context, log_event
from mesh.market.book import order_id
from mesh.market.rejections import reason_of
from schemas import ZERO_ADDRESS

if TYPE_CHECKING:
    import asyncio
    from collections.abc import Awaitable, Callable, Sequence

    from mesh.chain import Chain
    from mesh.clock import Clock
    from mesh.errors import AiraError
    from mesh.flood import Drops
    from mesh.market.earnings import EarningsLedger
    from mesh.market.funding import Commitments
    from mesh.market.liability_events import LiabilityEvents
    from mesh.market.rejections import RejectionPublisher
    from mesh.market.transaction_queue import TransactionQueue
    from schemas import Liability, Result, Verified

log = logging.getLogger(__name__)

HELD: Final = 16_384
"""Jurors' results that wait for others, at most; each is signed by a juror of a liability's own validator."""
SIGNERS_REMEMBERED: Final = 16_384
"""Signers of whom it is remembered whether a validator that is no jury accepts them."""
ACCEPTED_SECONDS: Final = 60.0
"""How long that is believed."""
PER_VALIDATOR: Final = Rate(per_second=2.0, burst=40)
"""Questions to a validator that is no jury, which may answer anything at the node's expense."""
ALL_VALIDATORS: Final = Rate(per_second=10.0, burst=200)
WASTED: Final = Rate(per_second=1 / 60, burst=3)
"""Finalizations that a validator which is no jury may let fail on the chain, at the provider's expense …"""
SHUNNED_SECONDS: Final = 600.0
"""… before it is not tried for so long: it may accept in a simulation what it refuses in a block."""
VALIDATOR_FINALIZES: Final = "NotTheValidator"
"""The contracts' error in generation 3, where only the validator itself finalizes."""
QUIET: Final = frozenset({"AlreadyFinalized", VALIDATOR_FINALIZES})
"""The contracts' errors for which a result is not rejected: it is not at fault."""


class Judgements:
    """Gathers the results of jurors until as many agree as a liability's validator needs."""

    def __init__(
        self,
        chain: Chain,
        events: LiabilityEvents,
        *,
        forget: Callable[..., None],
        drops: Drops,
        limit: int = HELD,
        clock: Clock = SYSTEM_CLOCK,
    ) -> None:
        self._chain = chain
        self._events = events
        self._forget = forget
        self._drops = drops
        self._limit = limit
        self._clock = clock
        self._held: dict[bytes, Verified[Result]] = {}
        """What was held, in order of arrival; some may be sent or used since."""
        self._accepted: BoundedDict[tuple[str, str], tuple[bool, float]] = BoundedDict(SIGNERS_REMEMBERED)
        """By validator and signer: whether it was accepted, and until when that holds, on the monotonic clock."""
        self._budget = RateLimiter(per_sender=PER_VALIDATOR, total=ALL_VALIDATORS, clock=clock)
        self._waste = RateLimiter(per_sender=WASTED, clock=clock)
        self._shunned: BoundedDict[str, float] = BoundedDict(SIGNERS_REMEMBERED)
        """Validators that let too many finalizations fail, and until when, on the monotonic clock."""

    async def add(self, result: Verified[Result], liability: Liability) -> Sequence[Verified[Result]]:
        """Hold a result of a validated liability, if a juror has signed it.

        Returns the results that finalize the liability together, once they are complete. A result of the promisor's is
        what jurors judge, and nothing here.
        """
        try:
            needed = await self._ask(partial(self._chain.validators.quorum, liability.validator))
            # An account finalizes itself, as in generation 3.
            if not needed or not await self._is_juror(result, liability):
                return ()
        except (RequestRefused, NoContracts) as error:
            log.debug("a result waits to be sent again: %s", error)
            self._forget(result)
            return ()
        self._hold(result)
        return self.agreeing(liability, needed)

    def agreeing(self, liability: Liability, needed: int) -> Sequence[Verified[Result]]:
        """So many held results of a liability that say the same; empty if there are none, or some are being sent."""
        held = self._events.unconfirmed.held(liability.address)
        for one in held if not self._is_shunned(liability.validator) else ():
            same = [other for other in held if other.hash == one.hash]
            if len(same) >= needed:
                return same[:needed]
        return ()

    async def wasted(self, liability: Liability) -> None:
        """A finalization of a liability failed on the chain: for how much that may be its validator's fault."""
        validator = liability.validator
        try:
            if validator == ZERO_ADDRESS or await self._ask(partial(self._chain.validators.jurors, validator)):
                return
        except (RequestRefused, NoContracts) as error:
            log.debug("it is not known whether %s is a jury: %s", validator, error)
        if not self._waste.allow(validator):
            self._shunned[validator] = self._clock.monotonic() + SHUNNED_SECONDS
            facts = log_event("validator-shunned", validator=validator, seconds=SHUNNED_SECONDS)
            log.warning("the validator %s lets finalizations fail on the chain", validator, extra=facts)

    def _is_shunned(self, validator: str) -> bool:
        return self._clock.monotonic() < self._shunned.get(validator, 0.0)

    def _hold(self, result: Verified[Result]) -> None:
        """Keep a result: the last one of its signer for a liability, and no more than the limit in all."""
        unconfirmed = self._events.unconfirmed
        for other in unconfirmed.held(result.message.liability):
            if other.signer == result.signer and other.hash != result.hash:
                unconfirmed.release(other)
        unconfirmed.hold(result)
        self._held[order_id(result)] = result
        while len(self._held) > self._limit:
            oldest = self._held.pop(next(iter(self._held)))
            if unconfirmed.release(oldest):
                self._drops.count("judgements-full", oldest.signer)
                self._forget(oldest)

    async def _is_juror(self, result: Verified[Result], liability: Liability) -> bool:
        """Whether the validator contract of a liability accepts who signed the result. Strangers are counted."""
        validator, signer = liability.validator, result.signer
        jurors = await self._ask(partial(self._chain.validators.jurors, validator))
        accepted = await self._is_accepted(result, validator) if jurors is None else signer in jurors
        if not accepted and signer != liability.promisor:
            self._drops.count("no-juror", signer)
        return accepted

    async def _is_accepted(self, result: Verified[Result], validator: str) -> bool:
        """Whether a validator that is no jury accepts who signed the result; if not, a later copy is asked about again.

        What it answers is believed for a while. Above the budget, nobody is accepted.
        """
        signer = result.signer
        accepted, until = self._accepted.get((validator, signer), (False, 0.0))
        if self._clock.monotonic() >= until:
            accepted = False
            if not self._is_shunned(validator) and self._budget.allow(validator):
                accepted = await self._ask(partial(self._chain.validators.accepts, validator, signer))
                self._accepted[validator, signer] = accepted, self._clock.monotonic() + ACCEPTED_SECONDS
        if not accepted:
            self._forget(result, after=ACCEPTED_SECONDS)
        return accepted

    async def _ask(self, question: Callable[[], Awaitable[Any]]) -> Any:
        """The chain's answer, asked for until the node is there. Raises `RequestRefused`."""
        return await self._chain.retrying(question, outages=self._events.lookups, errors=(NodeUnreachable,))


class ResultSettlement:
    """Finalizes liabilities by results, as the provider of the lighthouse at an address."""

    def __init__(
        self,
        chain: Chain,
        lighthouse: str,
        *,
        queue: TransactionQueue,
        earnings: EarningsLedger,
        events: LiabilityEvents,
        commitments: Commitments,
        rejections: RejectionPublisher,
        forget: Callable[..., None],
        drops: Drops,
    ) -> None:
        self._chain = chain
        self._lighthouse = lighthouse
        self._queue = queue
        self._earnings = earnings
        self._events = events
        self._commitments = commitments
        self._rejections = rejections
        self._forget = forget
        self._drops = drops
        self._judgements = Judgements(chain, events, forget=forget, drops=drops)

    def start(self, tasks: asyncio.TaskGroup) -> None:
        """From now on, finalize what is added in tasks of this group."""
        self._tasks = tasks

    async def add(self, result: Verified[Result]) -> None:
        """Finalize the liability that a result names, if the result may do that, or once it may with others."""
        address = result.message.liability
        await self.settle(result, (await self._events.liabilities([address])).get(address))

    async def settle(self, result: Verified[Result], liability: Liability | None) -> None:
        """The same for a liability that was looked up; None if the node knows none."""
        with liability_context(result.message.liability):
            if result in self._events.unconfirmed:
                return
            if liability is None or liability.is_finalized:  # which may not be confirmed either
                self._forget(result)
            elif liability.validator != ZERO_ADDRESS:
                self._begin(await self._judgements.add(result, liability), liability)
            elif result.signer != liability.promisor:
                self._rejections.reject(result, "WrongSigner", f"signed by {result.signer}, not by the promisor")
            elif not self._queue.has_room_for(self._chain.costs.worth(liability)):
                self._drops.count("queue-full", result.signer)
                self._forget(result)
            else:
                self._begin((result,), liability)

    def _begin(self, results: Sequence[Verified[Result]], liability: Liability) -> None:
        """Finalize a liability by these results, which say the same."""
        if results:
            self._events.unconfirmed.begin(*results)
            self._tasks.create_task(self._finalize(results, liability))

    async def _finalize(self, results: Sequence[Verified[Result]], liability: Liability) -> None:
        message, *others = (result.message for result in results)
        with liability_context(message.liability):
            try:
                priority = self._chain.costs.worth(liability)
                async with self._commitments.take({message.liability: 1}, waiting=self._queue.counted(priority)):
                    finalize = partial(self._chain.liabilities.finalize, self._lighthouse, message, *others)
                    finalized = await self._queue.send(finalize, priority=priority)
            except (Reverted, NodeUnreachable, NotOffered, RequestRefused) as error:
                if isinstance(error, Reverted) and error.gas_used:
                    await self._judgements.wasted(liability)
                self._not_finalized(results, error)
                self._begin(self._judgements.agreeing(liability, len(results)), liability)
            else:
                self._earnings.finalized(finalized)
                event = log_event("contract-finalized", success=message.success, gas=finalized.gas_used)
                log.info("finalized, success %s, gas %d", message.success, finalized.gas_used, extra=event)
                if not await self._events.is_confirmed(results, finalized.tx):
                    self._earnings.reverted(finalized.tx)
                for result in results:
                    if not self._events.unconfirmed.end(result):
                        await self.add(result)

    def _not_finalized(self, results: Sequence[Verified[Result]], error: AiraError) -> None:
        """Reject the results of a liability that they can't finalize, unless another way has ended or will end it."""
        reason = error.reason if isinstance(error, Reverted) else ""
        is_final = reason == VALIDATOR_FINALIZES or isinstance(error, NotOffered)
        for result in results:
            if reason not in QUIET:
                self._rejections.reject(result, reason_of(error), str(error))
            if not self._events.unconfirmed.end(result) and not is_final:
                self._forget(result)
