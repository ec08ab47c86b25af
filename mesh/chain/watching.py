"""Waiting until a sent transaction is mined: confirmed, made dearer when it is stuck, sent again when it was lost."""

from __future__ import annotations

import asyncio
import logging
from typing import TYPE_CHECKING, Final

from mesh.chain.errors import RequestRefused, TransactionTimeout
from mesh.chain.fees import Fees
from mesh.chain.node_metrics import TransactionOutcome
from mesh.chain.submission import count_mined, find_receipt, is_known, submit

if TYPE_CHECKING:
    from web3.types import TxReceipt

    from mesh.chain.accounts import Account, SignedTransaction
    from mesh.chain.node import Node
    from mesh.chain.pending import Pending, PendingTransactions

log = logging.getLogger(__name__)

LOOKS: Final = 3
"""How often a node has to say that a number is another transaction's: it may be behind with its own index."""


class NumberLost(Exception):
    """Another transaction was mined with the number: this one never will be, and may be sent with another."""


class Watch:
    """One wait for a transaction of an account's. The transaction stays in the outbox."""

    def __init__(self, node: Node, account: Account, outbox: PendingTransactions, entry: Pending) -> None:
        self._node = node
        self._account = account
        self._outbox = outbox
        self._entry = entry
        self._was_mined = False
        self._taken = 0

    async def mined(self) -> tuple[SignedTransaction, TxReceipt]:
        """The version that was mined, and its receipt, once it has the confirmations.

        Raises `NumberLost`, `TransactionTimeout`, `NodeUnreachable`.
        """
        timing = self._node.timing
        loop = asyncio.get_running_loop()
        pause = min(timing.receipt_interval, timing.poll_interval)
        replace_at = loop.time() + timing.replace_after
        try:
            async with asyncio.timeout(timing.receipt_timeout):
                while True:
                    found = await self._look()
                    if found is not None:
                        return found
                    if pause == timing.poll_interval and not self._was_mined:
                        await self._check_number()
                    if loop.time() >= replace_at and not self._was_mined:
                        await self._unblock()
                        replace_at = loop.time() + timing.replace_after
                    await asyncio.sleep(pause)
                    pause = min(pause * 1.5, timing.poll_interval)
        except TimeoutError:
            raise TransactionTimeout(self._entry.versions[-1].hash, timing.receipt_timeout) from None

    async def _look(self) -> tuple[SignedTransaction, TxReceipt] | None:
        confirmations = self._node.timing.confirmations
        head = await self._node.block_number() if confirmations > 1 else 0
        try:
            found = await find_receipt(self._node, reversed(self._entry.versions))
        except RequestRefused as refused:
            log.debug("%s: %s", self._newest.hash, refused)  # as nodes do that are still indexing; it was sent
            return None
        if found is not None:
            self._was_mined = True
            _, receipt = found
            return found if confirmations == 1 or head >= receipt["blockNumber"] + confirmations - 1 else None
        if self._was_mined:
            self._was_mined = False
            log.warning("the block with the transaction %s was replaced; sending it again", self._newest.hash)
            await self._send_again()
        return None

    @property
    def _newest(self) -> SignedTransaction:
        return self._entry.versions[-1]

    async def _check_number(self) -> None:
        """Raise `NumberLost` once it is certain."""
        if await count_mined(self._node, self._account.address) <= self._entry.nonce or await is_known(
            self._node, self._entry.versions
        ):
            self._taken = 0
            return
        self._taken += 1
        if self._taken == LOOKS:
            raise NumberLost

    async def _unblock(self) -> None:
        """Make the transaction that the others of the account wait behind dearer, if it is this one or nobody's."""
        number = await count_mined(self._node, self._account.address)
        if number == self._entry.nonce:
            await self._replace(self._entry)
        elif number < self._entry.nonce:
            left = next((entry for entry in self._outbox.abandoned if entry.nonce == number), None)
            if left is not None and await self._outbox.take_up(left):
                try:
                    await self._replace(left)
                finally:
                    self._outbox.abandon(left)
            elif number not in self._outbox.taken:
                log.warning("%s waits behind number %d of its account, sent elsewhere", self._newest.hash, number)

    async def _replace(self, entry: Pending) -> None:
        """Send another version with higher fees; the old one again where the ceiling leaves no room."""
        fees = await self._node.fees.bumped(self._node, Fees.of(entry.fields))
        stuck = entry.versions[-1]
        if fees is None:
            log.warning("the transaction %s is stuck, and its fees are at the ceiling", stuck.hash)
        else:
            fields = entry.fields | fees.fields()
            signed = self._account.sign_transaction({**fields, "nonce": entry.nonce})
            await self._outbox.add_version(entry, fields, signed)
            self._node.tally.count(TransactionOutcome.REPLACED)
            log.warning("the transaction %s is stuck; replaced by %s with higher fees", stuck.hash, signed.hash)
        await self._send_again(entry)

    async def _send_again(self, entry: Pending | None = None) -> None:
        """Give the newest version to the node, which may have it, or may have mined another meanwhile."""
        signed = (entry or self._entry).versions[-1]
        try:
            await submit(self._node, signed)
        except RequestRefused as refused:
            log.debug("%s: %s", signed.hash, refused)
