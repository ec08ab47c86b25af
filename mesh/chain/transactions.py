"""Sending transactions: simulate, price, number, sign, send, wait until mined.

The node never sees a key. A transaction that the contract would refuse is not sent: the estimate of its gas is the
simulation, and raises `Reverted`. Waiting is in `mesh.chain.confirmation`.
"""

from __future__ import annotations

import asyncio
import itertools
import logging
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

from mesh.chain.accounts import created_address
from mesh.chain.confirmation import Confirmation, NonceLost, find_receipt
from mesh.chain.errors import FeeTooHigh, InsufficientFunds, NodeUnreachable, RequestRefused, Reverted
from mesh.chain.metrics import TransactionOutcome
from mesh.chain.pending import PendingTransaction, effect_of
from mesh.chain.submission import is_known, is_nonce_taken, is_waiting_elsewhere, submit
from mesh.log_context import log_event
from mesh.retry import Backoff, RetryPolicy

if TYPE_CHECKING:
    from mesh.chain.abi import ContractCall
    from mesh.chain.accounts import Account, SignedTransaction
    from mesh.chain.answers import Log, MinedTransaction
    from mesh.chain.node import Node
    from mesh.chain.pending import PendingTransactions
    from mesh.chain.policy import Fees
    from mesh.errors import ChainError

log = logging.getLogger(__name__)

GAS_MARGIN_PERCENT: Final = 20
"""Gas above the estimate: the state may change until the transaction is mined. Unused gas costs nothing."""

NONCE_RETRY: Final = RetryPolicy(initial=0.0, ceiling=0.0, attempts=25)
"""For a nonce that another client of the account used first: the next one is tried without waiting."""


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
        self._node = node

    async def call(self, call: ContractCall) -> Receipt:
        """Send a call of a contract's function, and wait until it is mined. Raises as `send` does."""
        return await self.send(to=call.address, data=call.data)

    async def send(self, *, to: str | None, data: bytes, value: int = 0) -> Receipt:
        """Send `data` and `value` (wei) to an address, or deploy `data` if `to` is None; wait until it is mined.

        Raises `Reverted` (before anything is sent, or once it is mined and failed), `InsufficientFunds`, `FeeTooHigh`
        (nothing was sent), `TransactionTimeout`, `NodeUnreachable`, `RequestRefused`.
        """
        pending = self._node.pending_transactions(self.account.address)
        fields: dict[str, Any] = {"to": to or b"", "data": "0x" + data.hex(), "value": value}
        while True:
            before = await self._sent_before(pending, fields)
            since = b"" if before or self._node.heads.latest is None else self._node.heads.latest.hash
            entry = before or await self._send_new(pending, fields)
            confirmation = Confirmation(self._node, self.account, pending, entry, since=since)
            try:
                signed, receipt = await confirmation.wait()
                await pending.settle(entry, receipt)
            except NonceLost:
                log.info(
                    "nonce %d was used by another transaction; sending with the next",
                    entry.nonce,
                    extra=log_event("transaction-nonce-lost", tx=entry.newest.hash, nonce=entry.nonce),
                )
                await pending.forget(entry)
                self._node.metrics.count(TransactionOutcome.LOST)
                continue
            finally:
                pending.abandon(entry)
            return await self._outcome(entry, signed, receipt)

    async def last_nonce(self) -> int:
        """The highest nonce that a transaction of the account may have; -1 if it has sent none."""
        pending = self._node.pending_transactions(self.account.address)
        async with pending.lock:
            await pending.refresh()
        counted = await self._node.transaction_count(self.account.address, block="pending")
        return max((counted - 1, *pending.taken, *(entry.nonce for entry in pending.abandoned)))

    async def _send_new(self, pending: PendingTransactions, fields: dict[str, Any]) -> PendingTransaction:
        """Simulate, price, number, sign and send a transaction."""
        gas = await self._simulate(fields)
        limit = gas + gas * GAS_MARGIN_PERCENT // 100
        fees = await self._affordable_fees()
        complete = fields | fees.fields() | {"gas": limit, "chainId": self._node.chain_id}
        async with pending.lock:
            return await self._send_numbered(pending, complete)

    async def _simulate(self, fields: dict[str, Any]) -> int:
        """The gas that a transaction takes after the account's pending ones. Raises `Reverted` if it would fail."""
        try:
            return await self._node.estimate_gas(self._call(fields))
        except RequestRefused as refused:
            await self._raise_if_poor(fields, refused)
            raise
        except Reverted:
            self._node.metrics.count(TransactionOutcome.REFUSED)
            raise

    async def _affordable_fees(self) -> Fees:
        """What to offer now; waits up to `FeePolicy.patience` for the price to come down. Raises `FeeTooHigh`."""
        policy, loop = self._node.fees, asyncio.get_running_loop()
        until = loop.time() + policy.patience
        while True:
            try:
                return policy.offer(await self._node.gas_market())
            except FeeTooHigh:
                if loop.time() >= until:
                    raise
            await asyncio.sleep(self._node.timing.poll_interval)

    async def _send_numbered(self, pending: PendingTransactions, fields: dict[str, Any]) -> PendingTransaction:
        """Sign with the next nonce and send; again if another client was faster."""
        refused_nonces: set[int] = set()
        backoff = Backoff(NONCE_RETRY)
        failure: ChainError = NodeUnreachable(self._node.endpoint, "other clients of the account take all its nonces")
        while True:
            head = self._node.heads.latest
            nonce = await self._next_nonce(pending, refused_nonces)
            signed = self.account.sign_transaction(fields | {"nonce": nonce})
            entry = PendingTransaction(nonce=nonce, fields=fields, versions=[signed])
            if await pending.add(entry):
                pending.count(None, None)  # what becomes of this one is not known yet
                try:
                    await submit(self._node, signed)
                except RequestRefused as refused:
                    await pending.forget(entry)
                    await self._raise_if_poor(fields, refused)
                    if not is_nonce_taken(refused):
                        raise
                    if is_waiting_elsewhere(refused):
                        refused_nonces.add(nonce)
                    failure = refused
                except BaseException:
                    pending.abandon(entry)  # the node may have it
                    raise
                else:
                    pending.count(head, nonce + 1)
                    self._node.metrics.count(TransactionOutcome.SENT)
                    return entry
            log.debug("%s: nonce %d was taken; trying the next", self.account.address, nonce)
            if not await backoff.wait():
                raise failure

    async def _next_nonce(self, pending: PendingTransactions, refused: set[int]) -> int:
        """The first nonce that no transaction has, neither of those that the node knows nor of those we sent."""
        await pending.refresh()
        counted = pending.counted(self._node.heads.latest)
        if counted is None or pending.abandoned:
            counted = await self._node.transaction_count(self.account.address, block="pending")
        # A node behind a load balancer may not know what was just sent through another.
        waiting = [
            entry.nonce
            for entry in pending.abandoned
            if entry.nonce >= counted and await is_known(self._node, entry.versions)
        ]
        taken = {*pending.taken, *waiting, *refused}
        return next(nonce for nonce in itertools.count(counted) if nonce not in taken)

    async def _sent_before(self, pending: PendingTransactions, fields: dict[str, Any]) -> PendingTransaction | None:
        """The same transaction, sent before and waited for by nobody, if it is mined or can be."""
        async with pending.lock:
            await pending.refresh()
            if not pending.abandoned:
                return None
            mined = await self._node.transaction_count(self.account.address)
            for entry in pending.abandoned:
                if entry.nonce < mined and entry.sent_at + self._node.timing.repeat_within < time.time():
                    await pending.forget(entry)
                elif (
                    entry.effect == effect_of(fields) and await self._is_alive(entry) and await pending.take_over(entry)
                ):
                    log.info(
                        "the transaction %s was sent before; waiting for it",
                        entry.newest.hash,
                        extra=log_event("transaction-resumed", tx=entry.newest.hash),
                    )
                    return entry
        return None

    async def _is_alive(self, entry: PendingTransaction) -> bool:
        """Whether a transaction is mined, or can be now that the node has it (again)."""
        if await find_receipt(self._node, reversed(entry.versions)) is not None:
            return True
        try:
            await submit(self._node, entry.newest)
        except RequestRefused:
            return await is_known(self._node, entry.versions)
        return True

    async def _outcome(
        self, entry: PendingTransaction, signed: SignedTransaction, receipt: MinedTransaction
    ) -> Receipt:
        """The receipt of a mined transaction. Raises `Reverted` if it failed."""
        gas_used = receipt.gas_used
        wei = gas_used * receipt.effective_gas_price
        succeeded = receipt.status == 1
        self._node.metrics.count(TransactionOutcome.MINED if succeeded else TransactionOutcome.FAILED)
        self._node.metrics.paid(gas_used=gas_used, wei=wei)
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
            await self._node.call(self._call(fields), block=receipt.block_number)
        except Reverted as why:
            return why
        except RequestRefused as refused:
            return Reverted(refused.detail)
        except NodeUnreachable as lost:  # it has failed, whatever the reason
            log.debug("%s", lost)
        return Reverted("OutOfGas" if receipt.gas_used >= fields["gas"] else "")

    async def _raise_if_poor(self, fields: dict[str, Any], refused: RequestRefused) -> None:
        balance = await self._node.eth_balance(self.account.address)
        needed = fields.get("gas", 0) * fields.get("maxFeePerGas", fields.get("gasPrice", 0)) + fields["value"]
        if balance < needed:
            raise InsufficientFunds(self.account.address, balance=balance, needed=needed) from refused

    def _call(self, fields: dict[str, Any]) -> dict[str, Any]:
        """The same as a call, without prices: a simulation is not paid for."""
        call = {"from": self.account.address, "data": fields["data"], "value": fields["value"]}
        return call | ({"to": fields["to"]} if fields["to"] else {})
