"""Settlement: creates liabilities from matching orders, and finalizes them by results.

Other providers do the same, and the chain may replace its last blocks, so a receipt settles nothing. A match or result
stays under settlement until its event was read on the followed chain, in a block that counts (`Timing.finality`); if
the event vanishes, it is settled again (`mesh.market._orders` has the states). A message that leaves for another reason
(a contract refused it, another provider was first) is forgotten by its subscription, so that the next copy gets
through.

An order whose maker can't pay must not be matched: its match would take an honest order out of the book, and a turn of
the lighthouse, to learn that from the contracts. It stays in the book, unmatched, and is tried again.

A validated liability needs the same result of as many jurors as are its validator's quorum. They are gathered here, and
stay under settlement until the liability has ended and a reorganisation can't take that back. A juror sends its result
again until then, so nothing is kept on disk, and a result that is dropped here comes again.
"""

from __future__ import annotations

import asyncio
import logging
from collections import Counter
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any, Final, NamedTuple, TypeVar

from mesh.base.clock import SYSTEM_CLOCK
from mesh.base.flood import UNFUNDED_POLLS, BoundedDict, Rate, RateLimiter
from mesh.base.log_context import liability_context, log_event
from mesh.chain import (
    Finalized,
    Holding,
    NewLiability,
    NoContracts,
    NodeUnreachable,
    NotOffered,
    RequestRefused,
    Reverted,
    TransactionTimeout,
    permit_fee,
)
from mesh.errors import AiraError, ChainError, InputError, public_text
from mesh.market.book import RETRIED, Added, Match, OrderStage, order_id
from mesh.market.store import withdrawn_id
from mesh.market.transactions import Stakes
from mesh.role.following import follow_chain
from mesh.role.refunds import DueRefunds
from schemas import ZERO_ADDRESS, CreatedKey, Demand, Offer, RejectKey, Result, address_bytes
from schemas.signing import Refusal, Rejection

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Mapping, Sequence

    from mesh.base.flood import Drops
    from mesh.base.outage_log import OutageLog
    from mesh.chain import Account, Chain, ChainEvent
    from mesh.chain import Created as CreatedContract
    from mesh.market._earnings import EarningsLedger, FreeContracts
    from mesh.market._orders import Orders
    from mesh.market.book import Order
    from mesh.market.store import MarketStore, Withdrawals
    from mesh.market.transactions import TransactionQueue
    from mesh.network import Channel
    from mesh.role.following import ChainHead, Created
    from schemas import Liability, Permit, Verified, Withdrawal

log = logging.getLogger(__name__)

T = TypeVar("T")

PER_MAKER: Final = Rate(per_second=5.0, burst=500)
"""Rejections of one maker's messages."""
TOTAL: Final = Rate(per_second=50.0, burst=1000)
"""Rejections in all: each is signed, logged and published."""
ORDER_USED: Final = "OrderUsed"
"""The contracts' error for an order that became a liability, or was withdrawn there."""
NOT_PERMITTED: Final = "FeeNotPermitted"
"""Their error for a demand whose fee for a permit comes without a valid one."""
UNNAMED_ERROR: Final = "Reverted"
"""The reason of a rejection when the contract's error has no name."""


@dataclass(frozen=True, kw_only=True)
class SettlementParts:
    """What a provider settles with, on the market's open `channel`. It has read the chain up to `head`.

    `forget` lets the next copy of a message through, as `Subscription.forget`. `outages` are those of the node while
    the chain is followed, `lookups` while single facts are asked of it.
    """

    chain: Chain
    head: ChainHead
    outages: OutageLog
    lookups: OutageLog
    channel: Channel
    orders: Orders
    withdrawals: Withdrawals
    store: MarketStore
    queue: TransactionQueue
    earnings: EarningsLedger
    free: FreeContracts
    drops: Drops
    forget: Callable[..., None]

    @property
    def account(self) -> Account:
        assert self.chain.account is not None
        return self.chain.account

    @property
    def lighthouse(self) -> str:
        assert self.channel.address is not None
        return self.channel.address

    async def ask(self, question: Callable[[], Awaitable[T]]) -> T:
        """The chain's answer, asked for until the node is there. Raises `RequestRefused`."""
        return await self.chain.retrying(question, outages=self.lookups, errors=(NodeUnreachable,))


class RejectionPublisher:
    """Counts the rejections of a provider, and publishes them in its market; beyond a rate they are only counted."""

    def __init__(self, parts: SettlementParts) -> None:
        self._parts = parts
        self._limiter = RateLimiter(per_sender=PER_MAKER, total=TOTAL)

    def reject(self, message: Verified[Any], reason: str, detail: str) -> None:
        """Count and publish a rejection. A used order's sender knows already that it became a contract."""
        self._parts.earnings.rejected(reason)
        if not self._limiter.allow(message.signer):
            self._parts.drops.count("rejections", message.signer)
            return
        order = message.hash.hex()
        event = log_event("message-rejected", order=order, signer=message.signer, reason=reason)
        level = logging.INFO if reason == Refusal.WITHDRAWN else logging.WARNING
        log.log(level, "rejected %s of %s: %s", order, message.signer, detail, extra=event)
        if reason != ORDER_USED:
            self._publish(message.signer, order, reason, detail)

    def honour(self, withdrawal: Verified[Withdrawal]) -> None:
        """Publish, as a rejection of the withdrawn order, that this provider does not match it."""
        if not self._limiter.allow(withdrawal.signer):
            self._parts.drops.count("rejections", withdrawal.signer)
            return
        order = withdrawal.message.order
        event = log_event("withdrawal-honoured", order=order, signer=withdrawal.signer)
        log.info("%s withdrew the order %s", withdrawal.signer, order, extra=event)
        detail = "its maker has withdrawn it; this provider does not match it"
        self._publish(withdrawal.signer, order, Refusal.WITHDRAWN.value, detail)

    def _publish(self, maker: str, order: str, reason: str, detail: str) -> None:
        provider = self._parts.account.address
        rejection = Rejection(order=order, reason=reason, detail=public_text(detail), provider=provider)
        key = str(RejectKey(self._parts.channel.lighthouse, maker))
        self._parts.channel.put(key, rejection.signed_by(self._parts.account.signer).encode())


def at_fault(match: Match, error: str, arguments: Sequence[Any]) -> tuple[Verified[Order], ...]:
    """The orders that caused the contracts' `error` (name of a custom error) when a match was not created.

    Both orders, if the error and its arguments don't tell them apart.
    """
    both: tuple[Verified[Order], ...] = (match.demand, match.offer)
    match error, *arguments:
        case name, used if name == ORDER_USED:
            digest = bytes.fromhex(used.removeprefix("0x")) if isinstance(used, str) else used
            return tuple(order for order in both if order.hash == digest) or both
        case "DeadlineReached", deadline:
            return tuple(order for order in both if order.message.deadline == deadline) or both
        case "WrongSigner" | "ERC20InsufficientBalance", str(address), *_:
            return tuple(order for order in both if address_bytes(order.signer) == address_bytes(address)) or both
        case "InvalidSignature", *_:
            return both
        case "ERC20InsufficientAllowance", _, _, needed if needed == match.offer.message.lighthouse_fee:
            return both if needed in (match.demand.message.cost, match.demand.message.validator_fee) else (match.offer,)
        case "ERC20InsufficientAllowance" | "ValidatorWithoutCode" | "FeeNotPermitted", *_:
            return (match.demand,)
    return both


def reason_of(error: AiraError) -> str:
    """The machine-readable reason of a rejection: never a text that a stranger's token chose."""
    word = error.reason if isinstance(error, Reverted) else type(error).__name__
    return word if word.isidentifier() else UNNAMED_ERROR


class SettlementLimits(NamedTuple):
    """What a provider keeps and asks for while it settles orders and results."""

    liabilities: int = 65_536
    """Records of liabilities that are kept until they are finalized; others are read when their result arrives."""
    unfunded_at_once: int = 256
    """Unfunded orders that are looked at in one round, at most."""
    refund_patience: int = 2
    """Blocks for which a refund is left to the promisee, who may have ether after all."""
    missing_checks: int = 3
    """Checks in a row that find no trace of a mined transaction before it is sent again: one node may be behind
    another."""


SETTLEMENT_LIMITS: Final = SettlementLimits()


class LiabilityEvents:
    """What the events of the lighthouse's liabilities mean to a provider: it moves the orders by them.

    At most `open_limit` records of open liabilities are kept.
    """

    def __init__(self, parts: SettlementParts, *, open_limit: int) -> None:
        self.open: Final[BoundedDict[str, Liability]] = BoundedDict(open_limit)
        """Liabilities that were not finalized when they were read, by address."""
        self._parts = parts
        self._look_at = 0.0
        """When the latest block may be asked for again because of results, on the event loop's clock."""
        self._reverted: list[ChainEvent] = []
        self._again: list[Verified[Any]] = []
        self.refunds: Final = DueRefunds(
            parts.chain, parts.head, parts.outages, self._permitted, patience=SETTLEMENT_LIMITS.refund_patience
        )
        """Of the contracts that it has created with a permit: their promisees may lack the ether to ask for it."""

    async def follow(self, settle_again: Callable[[Verified[Any]], None]) -> None:
        """Read until cancelled, through outages of the node.

        `settle_again` is called with each message whose effect a reorganisation has reverted.
        """
        self._settle_again = settle_again
        await follow_chain(self, self._parts.chain, self._parts.head, self._parts.outages)

    async def on_event(self, event: ChainEvent, created: Created | None, block: int) -> None:
        """Take the orders of a new liability out of the book; note the end of another."""
        if isinstance(event, NewLiability | Finalized):
            self._parts.earnings.mined(event.tx)
        if created is not None:
            self._take_created(*created, block)
            self.refunds.end_reverted(created[0].address)
        elif isinstance(event, Finalized):
            self.open.pop(event.liability, None)
            self._parts.orders.finalized(event.liability, block)
            self.refunds.ended(event.liability)
            self._parts.store.forget_permitted(event.liability)

    async def on_revert(self, event: ChainEvent) -> None:
        """Wait for the others: the orders' versions come first."""
        self._reverted.append(event)

    async def on_reorganised(self, block: int) -> None:
        """Undo the events. The contracts refuse the orders that were used again."""
        before, reverted = self._parts.head.head, self._reverted
        self._reverted = []
        self._parts.orders.versions.reorganised(block, before)
        for event in reverted:
            if isinstance(event, NewLiability):
                self._parts.earnings.creation_reverted(event.liability, event.tx)
                self.open.pop(event.liability, None)
                self.refunds.ended(event.liability)
                self._parts.orders.versions.free(event.liability, before)
                self._again += self._parts.orders.reverted(event.liability, Demand, Offer)
            elif isinstance(event, Finalized):
                self._parts.earnings.reverted(event.tx)
                if self.refunds.end_reverted(event.liability):
                    self._parts.store.keep_permitted(event.liability)
                self._again += self._parts.orders.reverted(event.liability, Result)

    async def on_head(self, block: int) -> None:
        """Settle again what was reverted, and forget what can't change any more."""
        again, self._again = self._again, []
        for message in again:
            self._settle_again(message)
        self._parts.store.settle_sent(self._parts.orders.versions.expire(block), block)
        self._parts.orders.confirm(block)
        contract_block = self._parts.head.contract_block
        self._parts.withdrawals.expire(contract_block - self._parts.chain.node.timing.reorg_depth)
        for order in self._parts.orders.book.expire(contract_block):
            self._parts.forget(order)  # its deadline may be later than the book's limit
            facts = {"order": order.hash.hex(), "signer": order.signer}
            log.info("expired order %(order)s of %(signer)s", facts, extra=log_event("order-expired", **facts))
        await self._count_transactions(block)

    def created_with_permit(self, liability: str) -> None:
        """A contract was created with a permit: it is refunded in time, also after a restart."""
        self._parts.store.keep_permitted(liability)
        self.refunds.watch(liability)

    async def _permitted(self) -> list[str]:
        return self._parts.store.permitted()

    async def is_confirmed(self, messages: Sequence[Verified[Any]], tx: str) -> bool:
        """Wait until the event that used the messages counts; False if their transaction vanished."""
        node, missing = self._parts.chain.node, 0
        has_mined = partial(node.has_mined, tx)
        while missing < SETTLEMENT_LIMITS.missing_checks:
            counted = partial(node.counted, self._parts.head.head)
            until = await self._parts.chain.retrying(counted, outages=self._parts.lookups)
            if all(self._parts.orders.is_read(one, until=until) for one in messages):
                return True
            await asyncio.sleep(node.timing.poll_interval)
            is_there = all(self._parts.orders.is_read(one, until=self._parts.head.head) for one in messages)
            missing = (
                0
                if is_there or await self._parts.chain.retrying(has_mined, outages=self._parts.lookups)
                else missing + 1
            )
        return False

    async def liabilities(self, addresses: Sequence[str]) -> Mapping[str, Liability]:
        """The records of the liabilities that the node knows among these addresses."""
        if any(address not in self.open for address in addresses):
            await self._catch_up()
        known = {address: liability for address in addresses if (liability := self.open.get(address)) is not None}
        unknown = [address for address in dict.fromkeys(addresses) if address not in known]
        if not unknown:
            return known
        try:
            return known | await self._parts.ask(partial(self._parts.chain.liabilities.find_all, unknown))
        except (NoContracts, RequestRefused) as error:  # or a reorganisation took one
            log.debug("results wait to be sent again: %s", error)
            return known

    async def _catch_up(self) -> None:
        """Read on to the latest block, which agents may know before us: the records of what it has are read anyway."""
        node, now = self._parts.chain.node, asyncio.get_running_loop().time()
        is_due = not node.heads.is_pushed and now >= self._look_at
        if is_due:
            self._look_at = now + node.timing.poll_interval
        look = node.heads.look if is_due else node.heads.recent
        latest = await self._parts.chain.retrying(look, outages=self._parts.lookups)
        await self._parts.head.reached(latest.number)

    async def is_used(self, order: Verified[Demand | Offer]) -> bool:
        """Whether an order became a liability, or was withdrawn on the chain."""
        ask = partial(self._parts.chain.liabilities.is_used, order.message, order_hash=order.hash, signer=order.signer)
        try:
            return await self._parts.ask(ask)
        except RequestRefused:
            return False  # a used order is rejected when its next match fails

    async def _count_transactions(self, head: int) -> None:
        """Note which transactions of the account are not mined at a block, if an order waits for one."""
        account = self._parts.chain.account
        if account is None or not self._parts.orders.versions.need_count():
            return
        count = partial(self._parts.chain.node.transaction_count, account.address)
        mined, pending = 0, None
        try:
            mined, waiting = await asyncio.gather(count(block=head), count(block="pending"))
        except RequestRefused as error:  # a node that is behind, or met a reorganisation
            log.debug("the account's transactions can't be counted: %s", error)
        else:
            # While later ones wait, a transaction that the node has lost is sent again.
            pending = None if self._parts.chain.node.pending_transactions(account.address).taken else waiting
        self._parts.orders.versions.counted(mined, pending, head)

    def _take_created(self, liability: Liability, order_hashes: tuple[bytes, bytes], block: int) -> None:
        """Take the orders of a new liability, created in that block, out of the book."""
        if liability.lighthouse != self._parts.lighthouse:
            return
        for digest, signer in zip(order_hashes, (liability.promisee, liability.promisor), strict=True):
            self._parts.orders.book.known.add(signer)
            self._parts.orders.created(liability.address, block, digest + address_bytes(signer))
        if not liability.is_finalized:
            self.open[liability.address] = liability


class ValidatorLimits(NamedTuple):
    """What validators that are no juries may cost a provider: they may answer anything."""

    questions: Rate = Rate(per_second=2.0, burst=40)
    """Questions to one of them, at the node's expense."""
    questions_in_total: Rate = Rate(per_second=10.0, burst=200)
    """Questions to all of them."""
    signers: int = 16_384
    """Signers of whom it is remembered whether such a validator accepts them."""
    believed: float = 60.0
    """Seconds for which that is believed."""
    wasted: Rate = Rate(per_second=1 / 60, burst=3)
    """Finalizations that one of them may let fail on the chain, at the provider's expense …"""
    shunned: float = 600.0
    """… before it is not tried for so many seconds: it may accept in a simulation what it refuses in a block."""


VALIDATOR_LIMITS: Final = ValidatorLimits()
VALIDATOR_FINALIZES: Final = "NotTheValidator"
"""The contracts' error in generation 3, where only the validator itself finalizes."""
QUIET: Final = frozenset({"AlreadyFinalized", VALIDATOR_FINALIZES})
"""The contracts' errors for which a result is not rejected: it is not at fault."""


class Results:
    """Finalizes liabilities by results: the promisor's own, or so many jurors' as a liability's validator needs."""

    def __init__(self, parts: SettlementParts, events: LiabilityEvents, rejections: RejectionPublisher) -> None:
        self._parts = parts
        self._events = events
        self._rejections = rejections
        self._accepted: BoundedDict[tuple[str, str], tuple[bool, float]] = BoundedDict(VALIDATOR_LIMITS.signers)
        """By validator and signer: whether it was accepted, and until when that holds, on the monotonic clock."""
        self._budget = RateLimiter(per_sender=VALIDATOR_LIMITS.questions, total=VALIDATOR_LIMITS.questions_in_total)
        self._waste = RateLimiter(per_sender=VALIDATOR_LIMITS.wasted)
        self._shunned: BoundedDict[str, float] = BoundedDict(VALIDATOR_LIMITS.signers)
        """Validators that let too many finalizations fail, and until when, on the monotonic clock."""

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
            if self._parts.orders.settling(order_id(result)):
                return
            if liability is None or liability.is_finalized:  # which may not be confirmed either
                self._parts.forget(result)
            elif liability.validator != ZERO_ADDRESS:
                self._begin(await self._judge(result, liability), liability)
            elif result.signer != liability.promisor:
                self._rejections.reject(result, "WrongSigner", f"signed by {result.signer}, not by the promisor")
            elif not self._parts.queue.has_room_for(self._parts.chain.funds.worth(liability)):
                self._parts.drops.count("queue-full", result.signer)
                self._parts.forget(result)
            else:
                self._begin((result,), liability)

    def _begin(self, results: Sequence[Verified[Result]], liability: Liability) -> None:
        """Finalize a liability by these results, which say the same."""
        if results:
            self._parts.orders.begin(*results)
            self._tasks.create_task(self._finalize(results, liability))

    async def _finalize(self, results: Sequence[Verified[Result]], liability: Liability) -> None:
        message, *others = (result.message for result in results)
        with liability_context(message.liability):
            try:
                priority = self._parts.chain.funds.worth(liability)
                async with self._parts.queue.reserve(Stakes(alone=frozenset({message.liability})), priority=priority):
                    finalize = partial(self._parts.chain.liabilities.finalize, self._parts.lighthouse, message, *others)
                    self._parts.orders.sending(*results)
                    finalized = await self._parts.queue.send(finalize, priority=priority)
            except (Reverted, NodeUnreachable, NotOffered, RequestRefused) as error:
                if isinstance(error, Reverted) and error.gas_used:
                    await self._wasted(liability)
                self._not_finalized(results, error)
                self._begin(self._agreeing(liability, len(results)), liability)
            else:
                self._parts.earnings.finalized(finalized)
                self._parts.free.earned(liability, finalized.minted)
                event = log_event("contract-finalized", success=message.success, gas=finalized.gas_used)
                log.info("finalized, success %s, gas %d", message.success, finalized.gas_used, extra=event)
                if not await self._events.is_confirmed(results, finalized.tx):
                    self._parts.earnings.reverted(finalized.tx)
                for result in results:
                    if not self._parts.orders.end(result):
                        await self.add(result)

    def _not_finalized(self, results: Sequence[Verified[Result]], error: AiraError) -> None:
        """Reject the results of a liability that they can't finalize, unless another way has ended or will end it."""
        reason = error.reason if isinstance(error, Reverted) else ""
        is_final = reason == VALIDATOR_FINALIZES or isinstance(error, NotOffered)
        for result in results:
            if reason not in QUIET:
                self._rejections.reject(result, reason_of(error), str(error))
            if not self._parts.orders.end(result) and not is_final:
                self._parts.forget(result)

    async def _judge(self, result: Verified[Result], liability: Liability) -> Sequence[Verified[Result]]:
        """Hold a result of a validated liability, if a juror has signed it.

        Returns the results that finalize the liability together, once they are complete. A result of the promisor's is
        what jurors judge, and nothing here.
        """
        try:
            needed = await self._parts.ask(partial(self._parts.chain.validators.quorum, liability.validator))
            if not needed:  # an account, which finalizes itself, as in generation 3; or so a node says that is wrong
                self._parts.forget(result, after=VALIDATOR_LIMITS.believed)
                return ()
            if not await self._is_juror(result, liability):
                return ()
        except (RequestRefused, NoContracts) as error:
            log.debug("a result waits to be sent again: %s", error)
            self._parts.forget(result)
            return ()
        self._hold(result)
        return self._agreeing(liability, needed)

    def _agreeing(self, liability: Liability, needed: int) -> Sequence[Verified[Result]]:
        """So many held results of a liability that say the same; empty if there are none, or some are being sent."""
        held = self._parts.orders.held(liability.address)
        for one in held if not self._is_shunned(liability.validator) else ():
            same = [other for other in held if other.hash == one.hash]
            if len(same) >= needed:
                return same[:needed]
        return ()

    async def _wasted(self, liability: Liability) -> None:
        """A finalization of a liability failed on the chain: for how much that may be its validator's fault."""
        validator = liability.validator
        if validator == ZERO_ADDRESS:
            return
        try:
            jurors = await self._parts.ask(partial(self._parts.chain.validators.jurors, validator))
            if jurors is not None:
                return
        except (RequestRefused, NoContracts) as error:
            log.debug("it is not known whether %s is a jury: %s", validator, error)
        if not self._waste.allow(validator):
            self._shunned[validator] = SYSTEM_CLOCK.monotonic() + VALIDATOR_LIMITS.shunned
            facts = log_event("validator-shunned", validator=validator, seconds=VALIDATOR_LIMITS.shunned)
            log.warning("the validator %s lets finalizations fail on the chain", validator, extra=facts)

    def _is_shunned(self, validator: str) -> bool:
        return SYSTEM_CLOCK.monotonic() < self._shunned.get(validator, 0.0)

    def _hold(self, result: Verified[Result]) -> None:
        """Keep a result: the last one of its signer for a liability."""
        for other in self._parts.orders.held(result.message.liability):
            if other.signer == result.signer and other.hash != result.hash:
                self._parts.orders.release(other)
        if (oldest := self._parts.orders.hold(result)) is not None:
            self._parts.drops.count("judgements-full", oldest.signer)
            self._parts.forget(oldest)

    async def _is_juror(self, result: Verified[Result], liability: Liability) -> bool:
        """Whether the validator contract of a liability accepts who signed the result. Strangers are counted."""
        validator, signer = liability.validator, result.signer
        jurors = await self._parts.ask(partial(self._parts.chain.validators.jurors, validator))
        accepted = await self._is_accepted(result, validator) if jurors is None else signer in jurors
        if not accepted and signer != liability.promisor:
            self._parts.drops.count("no-juror", signer)
        return accepted

    async def _is_accepted(self, result: Verified[Result], validator: str) -> bool:
        """Whether a validator that is no jury accepts who signed the result; if not, a later copy is asked about again.

        What it answers is believed for a while. Above the budget, nobody is accepted.
        """
        signer = result.signer
        accepted, until = self._accepted.get((validator, signer), (False, 0.0))
        if SYSTEM_CLOCK.monotonic() >= until:
            accepted = False
            if not self._is_shunned(validator) and self._budget.allow(validator):
                accepted = await self._parts.ask(partial(self._parts.chain.validators.accepts, validator, signer))
                self._accepted[validator, signer] = accepted, SYSTEM_CLOCK.monotonic() + VALIDATOR_LIMITS.believed
        if not accepted:
            self._parts.forget(result, after=VALIDATOR_LIMITS.believed)
        return accepted


class MatchWithdrawn(ChainError, code="match-withdrawn"):
    """An order of a match was withdrawn or replaced, or its signer blocked, before a transaction was sent."""


class Settlement:
    """The settlement of one market by the chain's account. `matched` is called with each match."""

    blocked: frozenset[str] = frozenset()
    """The signers whose orders are not taken, as `block` was last called."""

    def __init__(
        self,
        parts: SettlementParts,
        *,
        matched: Callable[[Match], None],
        open_limit: int = SETTLEMENT_LIMITS.liabilities,
    ) -> None:
        self.events: Final = LiabilityEvents(parts, open_limit=open_limit)
        self.rejections: Final = RejectionPublisher(parts)
        self.results: Final = Results(parts, self.events, self.rejections)
        self._parts = parts
        self._versions = parts.orders.versions
        self._matched = matched
        self._interval = parts.chain.node.timing.poll_interval
        self._pause = UNFUNDED_POLLS * self._interval
        """Copies of what can't be taken yet are looked at again after this."""

    def start(self, tasks: asyncio.TaskGroup) -> None:
        """Follow the chain, and from now on settle what is added, in tasks of this group."""
        self._tasks = tasks
        self.results.start(tasks)
        tasks.create_task(self.events.follow(self._settle_again), name="provider chain")
        tasks.create_task(self._look_at_unfunded(), name="provider unfunded orders")
        tasks.create_task(self.events.refunds.run(), name="provider refunds")

    def add(self, order: Verified[Order]) -> Refusal | None:
        """Add an order to the book, and settle the match that it completes.

        If the book refuses the order, returns why, and publishes a rejection unless the order is known already.
        """
        if order.signer in self.blocked:
            self._drop_blocked(order)
            return Refusal.BLOCKED
        if self._parts.orders.is_paired(order):  # somebody else has published it, or its pair comes again
            self._parts.drops.count("paired", order.signer)
            self._parts.forget(order, after=self._pause)
            return Refusal.DUPLICATE
        outcome = self._parts.orders.add(order, head=self._parts.head.head)
        for evicted in outcome.evicted if isinstance(outcome, Added) else ():
            self._parts.drops.count("book-full", evicted.signer)
            self._parts.forget(evicted, after=2 * self._pause)  # in a flood, such copies cost the most
        if isinstance(outcome, Match):
            self._begin(outcome)
        elif isinstance(outcome, Refusal):
            is_no_promise = outcome is Refusal.WITHDRAWN and not self._may_promise(order_id(order))
            if outcome is not Refusal.DUPLICATE and not is_no_promise:
                self.rejections.reject(order, outcome.value, f"the order book refuses it: {outcome.value}")
            if outcome not in (Refusal.DUPLICATE, Refusal.WITHDRAWN):
                self._parts.forget(order, after=self._pause if outcome in RETRIED else 0.0)
            return outcome
        return None

    def pair(self, pair: Match) -> Refusal | None:
        """Settle a demand with the offer that its maker names, and match neither with another order; or say why not.

        Nothing of a pair waits in the book: its maker sends it again until the contract is on the chain.
        """
        if any(order.signer in self.blocked for order in pair):
            return Refusal.BLOCKED
        refusal = self._parts.orders.pair(pair, head=self._parts.head.head)
        if refusal is None:
            self._begin(pair)
        elif refusal is Refusal.DUPLICATE and self._parts.orders.is_pair(pair):
            return None  # it is under settlement
        return refusal

    def _begin(self, match: Match) -> None:
        facts = {"demand": match.demand.hash.hex(), "offer": match.offer.hash.hex()}
        log.info("matched demand %(demand)s and offer %(offer)s", facts, extra=log_event("orders-matched", **facts))
        self._parts.earnings.matched()
        self._matched(match)
        self._tasks.create_task(self._create(match))

    def set_aside(
        self,
        order: Verified[Order],
        reason: str,
        detail: str = "its maker lacks the money, or the factory may not take it",
        *,
        patience: float = 0.0,
    ) -> None:
        """Keep an order whose maker can't pay, unmatched, until it can; `reason` is the contracts' error for that.

        Its maker is told, for an order that is new after `patience` seconds: its permit may come a moment later.
        """
        now, is_new = asyncio.get_running_loop().time(), self._parts.orders.state(order_id(order)) is None
        if self._parts.orders.is_paired(order):
            self.rejections.reject(order, reason, detail)
        elif self._parts.orders.set_aside(order, now=now, head=self._parts.head.head):
            if patience and is_new:
                self._tasks.create_task(self._tell_later(order, reason, detail, patience))
            else:  # each copy, because an earlier rejection may have been lost
                self.rejections.reject(order, reason, detail)
        self._parts.forget(order, after=self._pause)

    async def _tell_later(self, order: Verified[Order], reason: str, detail: str, patience: float) -> None:
        await asyncio.sleep(patience)
        if self._parts.orders.state(order_id(order)) is OrderStage.UNFUNDED:
            self.rejections.reject(order, reason, detail)

    def withdraw(self, withdrawal: Verified[Withdrawal]) -> None:
        """Honour a withdrawal: its order leaves the book, and is refused until its deadline.

        A transaction that was sent already can't be stopped.
        """
        identity = withdrawn_id(withdrawal)
        is_open = self._parts.orders.settling(identity) is not None or self._parts.orders.book.stays(identity)
        # Also if it can't be promised: its maker does not want it any more.
        self._parts.orders.book.remove(identity, OrderStage.WITHDRAWN)
        if not self._parts.withdrawals.add(withdrawal, is_open=is_open):
            self._parts.drops.count("withdrawals", withdrawal.signer)
            self.rejections.reject(withdrawal, Refusal.FULL.value, "too many withdrawals")
            self._parts.forget(withdrawal)
            return
        self._tasks.create_task(self._confirm_withdrawal(withdrawal))

    async def _confirm_withdrawal(self, withdrawal: Verified[Withdrawal]) -> None:
        """Tell the maker, once the withdrawal is on the disk, that its order won't become a contract."""
        await self._parts.withdrawals.sync()
        identity = withdrawn_id(withdrawal)
        if self._may_promise(identity) and self._parts.orders.settling(identity) is None:
            self.rejections.honour(withdrawal)
        else:
            self._parts.forget(withdrawal, after=self._pause)

    def _may_promise(self, withdrawn: bytes) -> bool:
        """Whether a withdrawal is known to the end, and no transaction with its order may still succeed."""
        return self._parts.withdrawals.is_kept(withdrawn) and not self._versions.is_undecided(
            withdrawn, self._parts.head.head
        )

    async def _look_at_unfunded(self) -> None:
        """Ask after the makers of unfunded orders when that is due, and settle the orders of those that can pay."""
        clock = asyncio.get_running_loop().time
        while True:
            await asyncio.sleep(self._interval)
            records = self._parts.orders.to_look_at(clock(), SETTLEMENT_LIMITS.unfunded_at_once)
            shortages = await self.shortages([record.verified for record in records])
            for record, shortage in zip(records, shortages, strict=True):
                order = self._parts.orders.looked_at(record, is_funded=not shortage, now=clock())
                if order is not None:
                    self.add(order)

    def _settle_again(self, message: Verified[Any]) -> None:
        if isinstance(message.message, Result):
            self._tasks.create_task(self.results.add(message))
        else:
            self.add(message)

    def block(self, signers: frozenset[str]) -> None:
        """Take no orders of these signers, and drop those in the book. A transaction that was sent can't be stopped."""
        new, self.blocked = signers - self.blocked, signers
        for order in [order for signer in new for order in self._parts.orders.book.of(signer)]:
            self._parts.orders.book.remove(order_id(order), OrderStage.REFUSED)
            self._drop_blocked(order)

    def _drop_blocked(self, order: Verified[Order]) -> None:
        self._parts.drops.count("blocked", order.signer)
        self._parts.forget(order)

    async def _create(self, match: Match) -> None:
        parts, (demand, offer) = self._parts, match
        data_gas = await parts.chain.retrying(
            partial(parts.chain.liabilities.data_gas, demand.message, offer.message), outages=parts.lookups
        )
        fee = permit_fee(demand.message)
        if fee and await self._permit(match) is None:
            fee = 0
        if parts.free.lacking(match, data_gas=data_gas, permit_fee=fee) and not await parts.free.take(match):
            self._decline(match, data_gas)
            return
        try:
            priority = parts.chain.funds.worth(demand.message)
            async with parts.queue.reserve(self._stakes(match), priority=priority):
                shortage = next(filter(None, await self.shortages(match)), "")  # which may be over by now
                if shortage and await self._set_aside_unfunded(match, shortage, "its maker can't pay any more"):
                    return
                created = await parts.queue.send(self._creation(match, fee), priority=priority)
        except MatchWithdrawn:
            self._put_back(match)
        except Reverted as error:
            if error.reason == ORDER_USED or not await self._set_aside_unfunded(match, reason_of(error), str(error)):
                await self._not_created(match, at_fault(match, error.reason, error.arguments), error)
        except (NodeUnreachable, RequestRefused, InputError) as error:
            left = parts.chain.node.pending_transactions(parts.account.address).abandoned  # the node may have one
            self._versions.vanished(match, left[-1].nonce if left else None, parts.head.head)
            await self._not_created(match, match, error)
        else:
            self._versions.sent(match, created.nonce)
            key = CreatedKey(parts.channel.lighthouse, demand.message.model)
            parts.channel.put(str(key), created.liability.encode())
            paid = permit_fee(demand.message) if created.has_permit else 0
            in_xrt = paid if demand.message.token == parts.chain.xrt else 0
            parts.earnings.created(created, fee=offer.message.lighthouse_fee + in_xrt)
            if created.has_permit:
                self.events.created_with_permit(created.liability)
            facts = {"gas": created.gas_used, "permit_fee": paid, "demand": demand.hash.hex()}
            facts["offer"] = offer.hash.hex()
            with liability_context(created.liability):
                log.info("created, gas %(gas)d", facts, extra=log_event("contract-created", **facts))
            if not await self.events.is_confirmed(match, created.tx):
                parts.earnings.creation_reverted(created.liability, created.tx)
                self._versions.vanished(match, created.nonce, parts.head.head)
            self._put_back(match)
        finally:
            self._versions.ended(match, parts.head.head)

    async def _permit(self, match: Match) -> Permit | None:
        """The permit with which a match's liability would be created now."""
        ask = partial(self._parts.chain.funds.permit_for, match.demand)
        return await self._parts.chain.retrying(ask, outages=self._parts.lookups)

    def note_permit(self, permit: Verified[Permit]) -> None:
        """Remember a permit beside a demand: its maker can pay by it. It is sent again as often as the demand is."""
        message, is_blocked = permit.message, permit.signer in self.blocked
        if is_blocked or not self._parts.chain.funds.note(message):
            known = self._parts.chain.permits.of(permit.signer, bytes.fromhex(message.domain), message.nonce)
            if is_blocked or known != message:
                self._parts.drops.count("permits", permit.signer)
            self._parts.forget(permit, after=self._pause)

    def _stakes(self, match: Match) -> Stakes:
        """What creating a match's liability takes: what its orders cost, and the nonces of generation 5 in turn."""
        amounts: Counter[Holding] = Counter()
        for order in match:
            costs = self._parts.chain.funds.cost_of(order.message)
            amounts.update({Holding(token, order.signer): amount for token, amount in costs.items()})
        return Stakes(+amounts, frozenset(order.signer for order in match if order.message.generation == 5))

    def _decline(self, match: Match, data_gas: int) -> None:
        """A match does not cover the gas: drop the offer, let the demand wait for a better one, and tell both."""
        self._parts.orders.end(match.demand)
        self._parts.orders.end(match.offer, OrderStage.REFUSED)
        self._parts.drops.count("unpaid", match.offer.signer)
        self._parts.forget(match.offer, after=4 * self._pause)
        self.add(match.demand)
        orders = self._parts.orders
        is_waiting = order_id(match.demand) in orders.book or orders.is_paired(match.demand)
        for order in match if is_waiting else (match.offer,):
            self.rejections.reject(order, Refusal.UNPAID, self._parts.free.why(match, data_gas=data_gas))

    def _creation(self, match: Match, fee: int) -> Callable[[], Awaitable[CreatedContract]]:
        """What sends the transaction of a match. It raises as `Liabilities.create`, and `MatchWithdrawn`.

        With a `fee` for the demand's permit it raises `Reverted` if the permit can't be used any more.
        """
        parts, (demand, offer), may_be_sent = self._parts, match, False

        async def attempt() -> CreatedContract:
            nonlocal may_be_sent
            if not may_be_sent and any(self._is_taken_back(order) for order in match):
                raise MatchWithdrawn("an order was withdrawn or replaced before its contract was created")
            await parts.store.keep_sent(parts.orders.sending(*match))
            try:
                permit = await parts.chain.funds.permit_for(demand)
                if fee and permit is None and not may_be_sent:
                    raise Reverted(NOT_PERMITTED, arguments=(demand.signer,))
                create = partial(parts.chain.liabilities.create, parts.lighthouse, demand.message, offer.message)
                return await create(permit=permit)
            except (NodeUnreachable, TransactionTimeout):
                may_be_sent = True
                raise
            except Reverted as error:
                if error.block:
                    self._versions.failed(match, error.nonce, max(error.block, parts.head.head))
                raise

        return attempt

    def _is_taken_back(self, order: Verified[Order]) -> bool:
        return order.signer in self.blocked or self._parts.orders.taken_back(order, self._parts.head.head) is not None

    def _put_back(self, match: Match) -> None:
        """No transaction of a match waits any more: put its orders back into the book unless they were used."""
        for order in match:
            if not self._parts.orders.end(order):
                self.add(order)

    async def _set_aside_unfunded(self, match: Match, reason: str, detail: str) -> bool:
        """Keep the orders whose makers can't pay in the book, unmatched, and tell them; False if both can."""
        shortages = await self.shortages(match, fresh=True)
        unfunded = [order for order, shortage in zip(match, shortages, strict=True) if shortage]
        for order in match if unfunded else ():
            if self._parts.orders.end(order):
                continue
            if order in unfunded and order_id(order) not in self._parts.withdrawals:
                self.set_aside(order, reason, detail)
            else:
                self.add(order)
        return bool(unfunded)

    async def shortages(self, orders: Sequence[Verified[Order]], *, fresh: bool = False) -> list[str]:
        """What makers of orders lack to pay for them: see `Funds.shortages`. Asked until the node answers."""
        ask = partial(self._parts.chain.funds.shortages, orders, fresh=fresh)
        return await self._parts.chain.retrying(ask, outages=self._parts.lookups)

    async def _not_created(self, match: Match, rejected: tuple[Verified[Order], ...], error: AiraError) -> None:
        """Reject some orders of a match; put the other one back into the book, unless it was used meanwhile."""
        reason = reason_of(error)
        for order in match:
            was_used = self._parts.orders.end(order, OrderStage.REFUSED if order in rejected else OrderStage.RECEIVED)
            if order in rejected and (reason == ORDER_USED or not was_used):
                self.rejections.reject(order, reason, str(error))
            if was_used:
                continue
            if order in rejected or await self.events.is_used(order):
                self._parts.forget(order)
            else:
                self.add(order)
