"""Giving a signed transaction to the node, and waiting until it is mined and confirmed.

While it waits, a transaction is replaced by one with higher fees when it is stuck, sent again when the node lost it or
its block was replaced, and given up when another transaction was mined with its nonce.
"""

from __future__ import annotations

import asyncio
import logging
from contextlib import suppress
from typing import TYPE_CHECKING, Final

from mesh.chain.errors import NodeUnreachable, RequestRefused, TransactionTimeout
from mesh.chain.metrics import TransactionOutcome
from mesh.chain.pending import PendingTransaction
from mesh.chain.policy import Fees
from mesh.log_context import log_event
from mesh.retry import Backoff

if TYPE_CHECKING:
    from collections.abc import Iterable

    from mesh.chain.accounts import Account, SignedTransaction
    from mesh.chain.answers import MinedTransaction
    from mesh.chain.node import Node
    from mesh.chain.pending import PendingTransactions

log = logging.getLogger(__name__)

NONCE_CHECKS: Final = 3
"""How often in a row a node has to say that a nonce is used by another transaction: its index may be behind."""

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


class NonceLost(Exception):
    """Another transaction was mined with the nonce: this one never will be, and may be sent with another nonce."""


def is_nonce_taken(refused: RequestRefused) -> bool:
    """Whether a node refused a transaction because of its nonce."""
    return any(words in refused.detail.lower() for words in NONCE_TAKEN)


def is_waiting_elsewhere(refused: RequestRefused) -> bool:
    """Whether it did so because another transaction with the nonce waits, which it may not count."""
    return is_nonce_taken(refused) and "nonce" not in refused.detail.lower()


async def submit(node: Node, signed: SignedTransaction) -> None:
    """Give a transaction to the node, and again after a lost connection: the same bytes never count twice.

    Once an attempt may have arrived, the refusal of a later one may mean just that. Raises `NodeUnreachable`,
    `RequestRefused`.
    """
    backoff, may_have_arrived = Backoff(node.timing.request_retry), False
    while True:
        try:
            return await node.send_raw(signed.raw)
        except NodeUnreachable:
            may_have_arrived = True
            if not await backoff.wait():
                raise
        except RequestRefused:
            if may_have_arrived and await node.has_transaction(signed.hash):
                return None
            raise


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

    def __init__(
        self,
        node: Node,
        account: Account,
        pending: PendingTransactions,
        entry: PendingTransaction,
        *,
        since: bytes = b"",
    ) -> None:
        self._node = node
        self._account = account
        self._pending = pending
        self._entry = entry
        self._seen = since
        """The hash of the latest block when the receipt was looked for last."""
        self._replace_at = 0.0
        self._backoff = Backoff(node.timing.outage_retry)
        self._was_refused = False
        self._was_mined = False
        self._was_missed = False
        """Whether a new block was looked at that may have had it, and had it not: rarely is its nonce lost by then."""
        self._missing: int | None = None
        """The nonce before this one's that nothing was known to have when that was looked for last."""
        self._nonce_used = 0
        """Checks in a row that found the nonce used by another transaction."""

    async def wait(self) -> tuple[SignedTransaction, MinedTransaction]:
        """The version that was mined, and its receipt, once it has the confirmations.

        The node is asked for receipts when it has a new block. Raises `NonceLost`, `TransactionTimeout`,
        `NodeUnreachable`.
        """
        timing, loop = self._node.timing, asyncio.get_running_loop()
        self._replace_at = loop.time() + timing.replace_after
        try:
            async with asyncio.timeout(timing.receipt_timeout):
                found = await self._look_early()
                while found is None:
                    await self._news()
                    found = await self._find_confirmed()
                    if found is None and not self._was_mined:
                        if self._was_missed:
                            await self._check_nonce()
                        self._was_missed = True
                        if loop.time() >= self._replace_at:
                            await self._unblock()
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

    async def _news(self) -> None:
        """Wait for a block that may concern the transaction, or until it is time to look all the same."""
        with suppress(TimeoutError):
            async with asyncio.timeout_at(self._look_at()):
                while True:
                    head, seen = await self._node.heads.next(self._seen), self._seen
                    self._seen = head.hash
                    if self._was_mined or head.has_transactions or head.parent_hash != seen:
                        return

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
            log.warning(
                "the block with the transaction %s was replaced; sending it again",
                tx,
                extra=log_event("transaction-reverted", tx=tx),
            )
            await self._send_again(self._entry)
        return None

    async def _check_nonce(self) -> None:
        """Raise `NonceLost` once it is certain."""
        if await self._node.transaction_count(self._account.address) <= self._entry.nonce or await is_known(
            self._node, self._entry.versions
        ):
            self._nonce_used = 0
            return
        self._nonce_used += 1
        if self._nonce_used == NONCE_CHECKS:
            raise NonceLost

    async def _unblock(self) -> None:
        """Replace the transaction that holds up the account's others, if it is this one or nothing waits for it."""
        nonce = await self._node.transaction_count(self._account.address)
        if nonce == self._entry.nonce:
            await self._replace(self._entry)
        elif nonce < self._entry.nonce:
            blocking = self._pending.blocking(nonce)
            if blocking is not None and await self._pending.take_over(blocking):
                try:
                    await self._replace(blocking)
                finally:
                    self._pending.abandon(blocking)
            elif nonce not in self._pending.taken:
                await self._fill(nonce)

    async def _fill(self, nonce: int) -> None:
        """Use a nonce that the node knows no transaction of, so that later ones can be mined.

        A reorganisation took the one that had it, and a restart made us forget it. Others of the account may still send
        it: only a nonce that was missing twice is filled.
        """
        was_missing, self._missing, address = self._missing == nonce, nonce, self._account.address
        if not was_missing or await self._node.transaction_count(address, pending=True) != nonce:
            facts = {"tx": self._entry.newest.hash, "nonce": nonce}
            waits = "%(tx)s waits for nonce %(nonce)d of its account, which no transaction of this program has"
            log.warning(waits, facts, extra=log_event("transaction-blocked", **facts))
            return
        fields = self._entry.fields | {"to": address, "data": "0x", "value": 0}
        signed = self._account.sign_transaction({**fields, "nonce": nonce})
        filler = PendingTransaction(nonce=nonce, fields=fields, versions=[signed])
        async with self._pending.lock:
            await self._pending.refresh()
            if nonce in self._pending.taken or not await self._pending.add(filler):
                return
            try:
                await self._send_again(filler)
            finally:
                self._pending.abandon(filler)
        facts = {"tx": signed.hash, "nonce": nonce}
        filled = "nonce %(nonce)d of the account was lost; %(tx)s takes its place, and does nothing"
        log.warning(filled, facts, extra=log_event("transaction-filled", **facts))

    async def _replace(self, entry: PendingTransaction) -> None:
        """Send another version with higher fees, or the old one again if the ceiling leaves no room."""
        fees = self._node.fees.replacement(await self._node.gas_market(), Fees.of(entry.fields))
        stuck = entry.newest.hash
        if fees is None:
            log.warning(
                "the transaction %s is stuck, and its fees are at the ceiling",
                stuck,
                extra=log_event("transaction-stuck", tx=stuck),
            )
        else:
            fields = entry.fields | fees.fields()
            signed = self._account.sign_transaction({**fields, "nonce": entry.nonce})
            await self._pending.add_version(entry, fields, signed)
            self._node.metrics.count(TransactionOutcome.REPLACED)
            log.warning(
                "the transaction %s is stuck; replaced by %s with higher fees",
                stuck,
                signed.hash,
                extra=log_event("transaction-replaced", tx=stuck, replacement=signed.hash),
            )
        await self._send_again(entry)

    async def _send_again(self, entry: PendingTransaction) -> None:
        """Give the newest version to the node, which may have it, or may have mined another in the meantime."""
        try:
            await submit(self._node, entry.newest)
        except RequestRefused as refused:
            log.debug("%s: %s", entry.newest.hash, refused)
