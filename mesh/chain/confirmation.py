"""Waiting until a sent transaction is mined and confirmed.

Meanwhile it is replaced by one with higher fees when it is stuck, sent again when its block was replaced, and given up
when another transaction was mined with its nonce.
"""

from __future__ import annotations

import asyncio
import logging
from contextlib import suppress
from typing import TYPE_CHECKING, Final

from mesh.chain.errors import RequestRefused, TransactionTimeout
from mesh.chain.submission import Resubmission, is_known
from mesh.log_context import log_event
from mesh.retry import Backoff

if TYPE_CHECKING:
    from collections.abc import Iterable

    from mesh.chain.accounts import Account, SignedTransaction
    from mesh.chain.answers import MinedTransaction
    from mesh.chain.node import Node
    from mesh.chain.pending import PendingTransaction, PendingTransactions

log = logging.getLogger(__name__)

NONCE_CHECKS: Final = 3
"""How often in a row a node has to say that a nonce is used by another transaction: its index may be behind."""


class NonceLost(Exception):
    """Another transaction was mined with the nonce: this one never will be, and may be sent with another nonce."""


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
        self._resubmission = Resubmission(node, account, pending)
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
                            await self._resubmission.unblock(self._entry)
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
            await self._resubmission.send_again(self._entry)
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
