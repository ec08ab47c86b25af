"""Sending transactions: simulate, price, number, sign, send, wait until mined and confirmed.

The node never sees a key. A transaction that the contract would refuse is not sent: the estimate of its gas is the
simulation, and raises `Reverted`. While it waits, it is replaced by one with higher fees when it is stuck, sent again
when its block was replaced, and given up when another transaction was mined with its nonce.
"""

from __future__ import annotations

import asyncio
import itertools
import logging
import re
import time
from contextlib import suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final, NamedTuple

from mesh.amounts import ETH
from mesh.base.log_context import log_event
from mesh.base.retry import Backoff, RetryPolicy
from mesh.chain._accounts import created_address
from mesh.chain._node import Fees
from mesh.chain._pending import PendingTransaction, TransactionOutcome
from mesh.chain.errors import (
    InsufficientFunds,
    NodeUnreachable,
    RequestRefused,
    Reverted,
    TransactionTimeout,
)

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from mesh.chain._abi import ContractCall
    from mesh.chain._accounts import Account, SignedTransaction
    from mesh.chain._node import GasMarket, Node
    from mesh.chain._pending import PendingTransactions
    from mesh.chain.answers import Log, MinedTransaction
    from mesh.errors import ChainError


log = logging.getLogger(__name__)

NONCE_TAKEN: Final = (
    "nonce too low",
    "nonce too high",
    "underpriced",
    "already known",
    "known transaction",
    "already imported",
    "alreadyknown",
    "oldnonce",
)
"""What geth, anvil, nethermind, erigon and the embedded chain say when another transaction has the nonce."""

ABOVE_CAP: Final = ("exceeds the configured cap", "fee cap exceeded", "exceeds fee cap")
"""What geth, erigon, reth and besu say of a transaction that may cost more than `rpc.txfeecap`."""


def _says(refused: RequestRefused, words: Iterable[str]) -> bool:
    return any(some in refused.detail.lower() for some in words)


def _above_cap(refused: RequestRefused, fields: Mapping[str, Any]) -> RequestRefused:
    """The refusal with what the transaction may cost, and the price of gas at which the node would take it."""
    caps = re.findall(r"([0-9]{1,9}(?:\.[0-9]{1,18})?) ether", refused.detail)
    price = float(caps[-1]) * 10**9 / fields["gas"] if caps else 0
    until = f" until gas costs less than {price:.3g} gwei" if price else ""
    return RequestRefused(
        refused.method,
        refused.rpc_code,
        f"it may cost {ETH.show(fields['gas'] * Fees.of(fields).maximum)} ({fields['gas']:,} gas): {refused.detail}",
        hint=f"wait{until}, then do it again (`aira chain deploy` goes on where it stopped); or name a node with a "
        "higher cap (geth's is --rpc.txfeecap) with web3_http_provider",
        code="above-nodes-cap",
    )


async def submit(node: Node, signed: SignedTransaction) -> None:
    """Give a transaction to the node, and again after a lost connection: the same bytes never count twice.

    Once an attempt may have arrived, the refusal of a later one may mean just that; or it comes from another node,
    which says nothing about the first. Raises `NodeUnreachable` if the transaction may still be mined, `RequestRefused`
    if not.
    """
    backoff, may_have_arrived = Backoff(node.timing.request_retry), False
    while True:
        try:
            return await node.send_raw(signed.raw)
        except NodeUnreachable:
            may_have_arrived = True
            if not await backoff.wait():
                raise
        except RequestRefused as refused:
            if not may_have_arrived:
                raise
            if await node.has_transaction(signed.hash):
                return None
            if _says(refused, NONCE_TAKEN):
                raise
            why = f"it may have the transaction {signed.hash}, and refused it when it was sent again: {refused.detail}"
            raise NodeUnreachable(node.endpoint, why) from None


async def is_known(node: Node, versions: Iterable[SignedTransaction]) -> bool:
    """Whether the node has one of the versions of a transaction, mined or waiting."""
    for signed in versions:
        if await node.has_transaction(signed.hash):
            return True
    return False


async def find_receipt(
    node: Node, versions: Iterable[SignedTransaction]
) -> tuple[SignedTransaction, MinedTransaction] | None:
    """The version of a transaction that was mined, and its receipt; None if none was."""
    for signed in versions:
        receipt = await node.receipt(signed.hash)
        if receipt is not None:
            return signed, receipt
    return None


class Confirmation:
    """The wait for one transaction of an account, which stays among the account's pending ones.

    `since` is the hash of the latest block before it was sent, if that was just now.
    """

    def __init__(self, sender: TransactionSender, entry: PendingTransaction, *, since: bytes = b"") -> None:
        self._sender = sender
        self._node = node = sender.node
        self._entry = entry
        self._seen = since
        """The hash of the latest block when the receipt was looked for last."""
        self._replace_at = 0.0
        self._backoff = Backoff(node.timing.outage_retry)
        self._was_refused = False
        self._was_mined = False
        self._was_missed = False
        """Whether a new block was looked at that may have had it, and had it not: rarely is its nonce lost by then."""
        self._nonce_used = 0
        """Checks in a row that found the nonce used by another transaction."""

    async def wait(self) -> tuple[SignedTransaction, MinedTransaction] | None:
        """The version that was mined, and its receipt, once it has the confirmations.

        None if another transaction was mined with the nonce: this one never will be, and may be sent with another. The
        node is asked for receipts when it has a new block. Raises `TransactionTimeout`, `NodeUnreachable`.
        """
        timing, loop = self._node.timing, asyncio.get_running_loop()
        self._replace_at = loop.time() + timing.replace_after
        try:
            async with asyncio.timeout(timing.receipt_timeout):
                found = await self._look_early()
                while found is None:
                    if await self._news():
                        found = await self._find_confirmed()
                    if found is None and not self._was_mined:
                        if self._was_missed and await self._is_nonce_lost():
                            return None
                        self._was_missed = True
                        if loop.time() >= self._replace_at:
                            await self._sender.unblock(self._entry)
                            self._replace_at = loop.time() + timing.replace_after
        except TimeoutError:
            raise TransactionTimeout(self._entry.newest.hash, timing.receipt_timeout) from None
        self._node.heads.expect(found[1].block_number)
        return found

    async def _look_early(self) -> tuple[SignedTransaction, MinedTransaction] | None:
        """Look before the next block, unless that comes to our notice at once: some chains mine without delay."""
        if self._seen and self._node.heads.are_timely:
            return None
        found = await self._find_confirmed()
        if found is None and not self._was_mined:
            await asyncio.sleep(self._node.timing.receipt_interval)
            found = await self._find_confirmed()
        return found

    async def _news(self) -> bool:
        """Wait for a block with transactions, or until it is time to look; whether it may have this transaction."""
        with suppress(TimeoutError):
            async with asyncio.timeout_at(self._look_at()):
                while True:
                    head, seen = await self._node.heads.next(self._seen), self._seen
                    self._seen = head.hash
                    if self._was_mined or head.parent_hash != seen:
                        return True
                    if head.has_transactions:
                        return head.may_hold(version.hash for version in self._entry.versions)
        return True

    def _look_at(self) -> float | None:
        """When to look without a new block: a node's index may be behind its blocks."""
        now, timing = asyncio.get_running_loop().time(), self._node.timing
        if self._nonce_used or self._was_refused:
            return now + timing.poll_interval
        soon = None if self._node.heads.are_timely else now + 2 * (self._backoff.next_delay() or timing.poll_interval)
        if self._was_mined:
            return soon
        return self._replace_at if soon is None else min(soon, self._replace_at)

    async def _find_confirmed(self) -> tuple[SignedTransaction, MinedTransaction] | None:
        """The version that was mined, if it has the confirmations. Sends it again if its block was replaced."""
        confirmations = self._node.timing.confirmations
        head = (await self._node.heads.recent()).number if confirmations > 1 else 0
        tx = self._entry.newest.hash
        self._was_refused = False
        try:
            found = await find_receipt(self._node, reversed(self._entry.versions))
        except RequestRefused as refused:
            log.debug("%s: %s", tx, refused)  # as nodes do that are still indexing; it was sent
            self._was_refused = True
            return None
        if found is not None:
            self._was_mined = True
            _, receipt = found
            return found if confirmations == 1 or head >= receipt.block_number + confirmations - 1 else None
        if self._was_mined:
            self._was_mined = False
            facts = log_event("transaction-reverted", tx=tx)
            log.warning("the block with the transaction %s was replaced; sending it again", tx, extra=facts)
            await self._sender.send_again(self._entry)
        return None

    async def _is_nonce_lost(self) -> bool:
        """Whether it is certain that another transaction has the nonce."""
        if await self._node.transaction_count(self._sender.account.address) <= self._entry.nonce or await is_known(
            self._node, self._entry.versions
        ):
            self._nonce_used = 0
        else:
            self._nonce_used += 1
        return self._nonce_used == 3  # the node's index may be behind


class CostLimits(NamedTuple):
    """What a transaction may cost."""

    nodes_cap: int = 10**18
    """Wei: nodes refuse a transaction that may cost more than 1 ETH (geth's `rpc.txfeecap`)."""
    margin: int = 20
    """Percent of gas above the estimate: the state may change until it is mined. Unused gas costs nothing."""


COST_LIMITS: Final = CostLimits()

NONCE_RETRY: Final = RetryPolicy(initial=0.0, ceiling=0.0, attempts=25)
"""For a nonce that another client of the account used first: the next one is tried without waiting."""


def within_cap(fees: Fees, market: GasMarket, gas: int) -> tuple[Fees, int]:
    """What a transaction that takes `gas` offers, and its gas limit, so that nodes with geth's cap take it.

    First the room for a higher base fee shrinks, then the margin of gas; never below what it costs now.
    """
    cap, limit = COST_LIMITS.nodes_cap, gas + gas * COST_LIMITS.margin // 100
    price = min(fees.maximum, market.price)
    if fees.priority is not None and limit * fees.maximum > cap:
        fees = Fees(max(price, min(fees.maximum, cap // limit)), min(fees.priority, price))
    return fees, max(gas, min(limit, cap // max(fees.maximum, 1)))


@dataclass(frozen=True, slots=True)
class Receipt:
    """A mined transaction that succeeded. `contract` is what it deployed, if anything.

    `wei` is what its gas cost, `nonce` its number among the account's transactions.
    """

    tx: str
    nonce: int
    block_number: int
    gas_used: int
    wei: int
    contract: str | None
    logs: tuple[Log, ...]


class TransactionSender:
    """Sends transactions of one account; safe to use from many tasks of one event loop at once.

    Transactions of one account through one node are numbered one after another under a lock; with the node's
    transaction folder, so are those of all processes that share it. Without it, other clients of the account may use
    the same nonces: then a transaction is sent again with the next nonce.

    A transaction with an unknown outcome is kept: its sender lost the node, gave up waiting or was cancelled, or (with
    a transaction folder) its process ended. Sending the same again (same recipient, data and value) continues with it
    instead of sending a second one, unless it was mined more than `Timing.repeat_within` ago. The nonce of one that the
    node has forgotten is used for the next.
    """

    def __init__(self, node: Node, account: Account) -> None:
        self.account = account
        self.node = node

    @property
    def _pending(self) -> PendingTransactions:
        """What all senders of the account share: the table."""
        return self.node.pending_transactions(self.account.address)

    async def call(self, call: ContractCall) -> Receipt:
        """Send a call of a contract's function, and wait until it is mined. Raises as `send` does."""
        return await self.send(to=call.address, data=call.data)

    async def send(self, *, to: str | None, data: bytes, value: int = 0) -> Receipt:
        """Send `data` and `value` (wei) to an address, or deploy `data` if `to` is None; wait until it is mined.

        Raises `Reverted` (before anything is sent, or once it is mined and failed), `InsufficientFunds`, `FeeTooHigh`
        (nothing was sent), `TransactionTimeout`, `NodeUnreachable`, `RequestRefused`.
        """
        fields: dict[str, Any] = {"to": to or "", "data": "0x" + data.hex(), "value": value}
        while True:
            before = await self._sent_before(fields)
            since = b"" if before or self.node.heads.latest is None else self.node.heads.latest.hash
            entry = before or await self._send_new(fields)
            try:
                found = await Confirmation(self, entry, since=since).wait()
                if found is None:
                    self._pending.forget(entry)
                else:
                    self._pending.settle(entry, found[1])
            finally:
                self._pending.abandon(entry)
            if found is not None:
                return await self._outcome(entry, *found)
            facts = log_event("transaction-nonce-lost", tx=entry.newest.hash, nonce=entry.nonce)
            log.info("nonce %d was used by another transaction; sending with the next", entry.nonce, extra=facts)
            self.node.sent.by_outcome[TransactionOutcome.LOST] += 1

    async def last_nonce(self) -> int:
        """The highest nonce that a transaction of the account may have; -1 if it has sent none."""
        async with self._pending.lock:
            await self._pending.refresh()
        counted = await self.node.transaction_count(self.account.address, block="pending")
        return max((counted - 1, *self._pending.taken, *(entry.nonce for entry in self._pending.abandoned)))

    async def _send_new(self, fields: dict[str, Any]) -> PendingTransaction:
        """Simulate, price, number, sign and send a transaction."""
        gas = await self._simulate(fields)
        market = await self.node.gas_market()
        fees, limit = within_cap(self.node.fees.offer(market), market, gas)
        complete = fields | fees.fields() | {"gas": limit, "chainId": self.node.chain_id}
        async with self._pending.lock:
            return await self._send_numbered(complete)

    async def _simulate(self, fields: dict[str, Any]) -> int:
        """The gas that a transaction takes after the account's pending ones. Raises `Reverted` if it would fail."""
        try:
            return await self.node.estimate_gas(self._call(fields))
        except RequestRefused as refused:
            await self._raise_if_poor(fields, refused)
            raise
        except Reverted:
            self.node.sent.by_outcome[TransactionOutcome.REFUSED] += 1
            raise

    async def _send_numbered(self, fields: dict[str, Any]) -> PendingTransaction:
        """Sign with the next nonce and send; again if another client was faster."""
        refused_nonces: set[int] = set()
        backoff = Backoff(NONCE_RETRY)
        failure: ChainError = NodeUnreachable(self.node.endpoint, "other clients of the account take all its nonces")
        while True:
            head = self.node.heads.latest
            nonce = await self._next_nonce(refused_nonces)
            signed = self.account.sign_transaction(fields | {"nonce": nonce})
            entry = PendingTransaction(nonce=nonce, fields=fields, versions=[signed])
            if await self._pending.add(entry):
                self._pending.count(None, None)  # what becomes of this one is not known yet
                try:
                    await submit(self.node, signed)
                except RequestRefused as refused:
                    self._pending.forget(entry)
                    await self._raise_if_poor(fields, refused)
                    if _says(refused, ABOVE_CAP):
                        raise _above_cap(refused, fields) from refused
                    if not _says(refused, NONCE_TAKEN):
                        raise
                    if not _says(refused, ["nonce"]):  # another one waits with it, which the node may not count
                        refused_nonces.add(nonce)
                    failure = refused
                except BaseException:
                    self._pending.abandon(entry)  # the node may have it
                    raise
                else:
                    self._pending.count(head, nonce + 1)
                    self.node.sent.by_outcome[TransactionOutcome.SENT] += 1
                    return entry
            log.debug("%s: nonce %d was taken; trying the next", self.account.address, nonce)
            if not await backoff.wait():
                raise failure

    async def _next_nonce(self, refused: set[int]) -> int:
        """The first nonce that no transaction has, neither of those that the node knows nor of those we sent."""
        await self._pending.refresh()
        counted = self._pending.counted(self.node.heads.latest)
        if counted is None or self._pending.abandoned:
            counted = await self.node.transaction_count(self.account.address, block="pending")
        # A node behind a load balancer may not know what was just sent through another.
        waiting = [
            entry.nonce
            for entry in self._pending.abandoned
            if entry.nonce >= counted and await is_known(self.node, entry.versions)
        ]
        taken = {*self._pending.taken, *waiting, *refused}
        return next(nonce for nonce in itertools.count(counted) if nonce not in taken)

    async def _sent_before(self, fields: dict[str, Any]) -> PendingTransaction | None:
        """The same transaction, sent before and waited for by nobody, if it is mined or can be."""
        async with self._pending.lock:
            await self._pending.refresh()
            if not self._pending.abandoned:
                return None
            mined = await self.node.transaction_count(self.account.address)
            for entry in self._pending.abandoned:
                if entry.nonce < mined and entry.sent_at + self.node.timing.repeat_within < time.time():
                    self._pending.forget(entry)
                elif (
                    _effect(entry.fields) == _effect(fields)
                    and await self._is_alive(entry)
                    and await self._pending.take_over(entry)
                ):
                    facts = log_event("transaction-resumed", tx=entry.newest.hash)
                    log.info("the transaction %s was sent before; waiting for it", entry.newest.hash, extra=facts)
                    return entry
        return None

    async def _is_alive(self, entry: PendingTransaction) -> bool:
        """Whether a transaction is mined, or can be now that the node has it (again)."""
        if await find_receipt(self.node, reversed(entry.versions)) is not None:
            return True
        try:
            await submit(self.node, entry.newest)
        except RequestRefused:
            return await is_known(self.node, entry.versions)
        return True

    async def send_again(self, entry: PendingTransaction) -> None:
        """Give the newest version to the node, which may have it, or may have mined another in the meantime."""
        try:
            await submit(self.node, entry.newest)
        except RequestRefused as refused:
            log.debug("%s: %s", entry.newest.hash, refused)

    async def _bump(self, entry: PendingTransaction) -> None:
        """Send another version with higher fees, or the old one again if the ceiling leaves no room."""
        fees = self.node.fees.replacement(await self.node.gas_market(), Fees.of(entry.fields))
        stuck = entry.newest.hash
        if fees is None:
            facts = log_event("transaction-stuck", tx=stuck)
            log.warning("the transaction %s is stuck, and its fees are at the ceiling", stuck, extra=facts)
        else:
            fields = entry.fields | fees.fields()
            signed = self.account.sign_transaction({**fields, "nonce": entry.nonce})
            await self._pending.add_version(entry, fields, signed)
            self.node.sent.by_outcome[TransactionOutcome.REPLACED] += 1
            replaced = "the transaction %s is stuck; replaced by %s with higher fees"
            facts = log_event("transaction-replaced", tx=stuck, replacement=signed.hash)
            log.warning(replaced, stuck, signed.hash, extra=facts)
        await self.send_again(entry)

    async def unblock(self, waiting: PendingTransaction) -> None:
        """Replace a transaction that has waited too long, or have the account's earlier nonces used.

        Many transactions may wait for the same nonces: one of them sees to these, each `Timing.replace_after`.
        """
        nonce = await self.node.transaction_count(self.account.address)
        if nonce == waiting.nonce:
            await self._bump(waiting)
        elif nonce < waiting.nonce and self._pending.may_unblock(self.node.timing.replace_after):
            await self._use_nonces(nonce, waiting)

    async def _use_nonces(self, first: int, waiting: PendingTransaction) -> None:
        """Have the nonces from `first` to that of `waiting` used, as far as the node has no transactions with them."""
        was_missing, self._pending.missing = self._pending.missing == first, None
        nonce, gap = first - 1, first
        while nonce < gap < waiting.nonce:
            nonce = gap
            if not await self._resubmit(nonce, is_first=nonce == first) and (
                nonce in self._pending.taken or not await self._fill(nonce, waiting, was_missing=was_missing)
            ):
                return
            gap = await self.node.transaction_count(self.account.address, block="pending")

    async def _resubmit(self, nonce: int, *, is_first: bool) -> bool:
        """Send the transaction with a nonce again; False if there is none, or another process waits for it."""
        async with self._pending.lock:  # what sends the same meanwhile must find it
            sent = self._pending.sent(nonce)
            if sent is not None and sent.is_watched:
                await self.send_again(sent)
                return True
            if sent is None or not await self._pending.take_over(sent):
                return False
            try:
                await (self._bump(sent) if is_first else self.send_again(sent))
            finally:
                self._pending.abandon(sent)
        return True

    async def _fill(self, nonce: int, waiting: PendingTransaction, *, was_missing: bool) -> bool:
        """Use a nonce that the node knows no transaction of, so that later ones can be mined; whether it was done.

        A reorganisation took the one that had it, and a restart made us forget it. Others of the account may still send
        it: nothing is filled before the first nonce was missing twice.
        """
        address = self.account.address
        if not was_missing or await self.node.transaction_count(address, block="pending") != nonce:
            self._pending.missing = nonce
            facts = {"tx": waiting.newest.hash, "nonce": nonce}
            waits = "%(tx)s waits for nonce %(nonce)d of its account, which no transaction of this program has"
            log.warning(waits, facts, extra=log_event("transaction-blocked", **facts))
            return False
        fields = waiting.fields | {"to": address, "data": "0x", "value": 0}
        signed = self.account.sign_transaction({**fields, "nonce": nonce})
        filler = PendingTransaction(nonce=nonce, fields=fields, versions=[signed])
        async with self._pending.lock:
            await self._pending.refresh()
            if nonce in self._pending.taken or not await self._pending.add(filler):
                return False
            try:
                await self.send_again(filler)
            finally:
                self._pending.abandon(filler)
        facts = {"tx": signed.hash, "nonce": nonce}
        filled = "nonce %(nonce)d of the account was lost; %(tx)s takes its place, and does nothing"
        log.warning(filled, facts, extra=log_event("transaction-filled", **facts))
        return True

    async def _outcome(
        self, entry: PendingTransaction, signed: SignedTransaction, receipt: MinedTransaction
    ) -> Receipt:
        """The receipt of a mined transaction. Raises `Reverted` if it failed."""
        gas_used = receipt.gas_used
        # Where the node does not say at which price, the most that the transaction offered: it has cost no more.
        wei = receipt.wei(price=Fees.of(entry.fields).maximum)
        assert wei is not None
        succeeded = receipt.status == 1
        self.node.sent.by_outcome[TransactionOutcome.MINED if succeeded else TransactionOutcome.FAILED] += 1
        self.node.sent.gas_used += gas_used
        self.node.sent.wei += wei
        self.node.sent.data_wei += receipt.l1_fee or 0
        if not succeeded:
            why = await self._why_failed(entry.fields, receipt)
            raise Reverted(
                why.reason,
                arguments=why.arguments,
                data=why.data,
                gas_used=gas_used,
                wei=wei,
                block=receipt.block_number,
                nonce=entry.nonce,
            )
        return Receipt(
            tx=signed.hash,
            nonce=entry.nonce,
            block_number=receipt.block_number,
            gas_used=gas_used,
            wei=wei,
            # A node may leave it out, or name a contract of its own.
            contract=None if entry.fields["to"] else created_address(self.account.address, entry.nonce),
            logs=tuple(receipt.logs),
        )

    async def _why_failed(self, fields: dict[str, Any], receipt: MinedTransaction) -> Reverted:
        """Why a mined transaction failed although its simulation succeeded: asked of the state after its block."""
        try:
            await self.node.call(self._call(fields), block=receipt.block_number)
        except Reverted as why:
            return why
        except (RequestRefused, NodeUnreachable) as lost:  # the node's reason, not the contract's
            log.debug("%s", lost)
        return Reverted("OutOfGas" if receipt.gas_used >= fields["gas"] else "")

    async def _raise_if_poor(self, fields: dict[str, Any], refused: RequestRefused) -> None:
        balance = await self.node.eth_balance(self.account.address)
        needed = fields.get("gas", 0) * fields.get("maxFeePerGas", fields.get("gasPrice", 0)) + fields["value"]
        needed += await self.node.data_fee(bytes.fromhex(fields["data"][2:]))
        if balance < needed:
            raise InsufficientFunds(self.account.address, balance=balance, needed=needed) from refused

    def _call(self, fields: dict[str, Any]) -> dict[str, Any]:
        """The same as a call, without prices: a simulation is not paid for."""
        call = {"from": self.account.address, "data": fields["data"], "value": fields["value"]}
        return call | ({"to": fields["to"]} if fields["to"] else {})


def _effect(fields: Mapping[str, Any]) -> tuple[Any, ...]:
    """What a transaction with these fields does."""
    return fields["to"], fields["data"], fields["value"]
