"""Giving signed transactions to the node: the first time, again, and with higher fees when they are stuck."""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING, Final

from mesh.chain.errors import NodeUnreachable, RequestRefused
from mesh.chain.metrics import TransactionOutcome
from mesh.chain.pending import PendingTransaction
from mesh.chain.policy import Fees
from mesh.log_context import log_event
from mesh.retry import Backoff

if TYPE_CHECKING:
    from collections.abc import Iterable

    from mesh.chain.accounts import Account, SignedTransaction
    from mesh.chain.node import Node
    from mesh.chain.pending import PendingTransactions

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


def is_nonce_taken(refused: RequestRefused) -> bool:
    """Whether a node refused a transaction because of its nonce."""
    return any(words in refused.detail.lower() for words in NONCE_TAKEN)


def is_waiting_elsewhere(refused: RequestRefused) -> bool:
    """Whether it did so because another transaction with the nonce waits, which it may not count."""
    return is_nonce_taken(refused) and "nonce" not in refused.detail.lower()


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
            if is_nonce_taken(refused):
                raise
            why = f"it may have the transaction {signed.hash}, and refused it when it was sent again: {refused.detail}"
            raise NodeUnreachable(node.endpoint, why) from None


async def is_known(node: Node, versions: Iterable[SignedTransaction]) -> bool:
    """Whether the node has one of the versions of a transaction, mined or waiting."""
    for signed in versions:
        if await node.has_transaction(signed.hash):
            return True
    return False


class Resubmission:
    """Sends transactions of an account again, with higher fees or in the place of lost ones."""

    def __init__(self, node: Node, account: Account, pending: PendingTransactions) -> None:
        self._node = node
        self._account = account
        self._pending = pending

    async def send_again(self, entry: PendingTransaction) -> None:
        """Give the newest version to the node, which may have it, or may have mined another in the meantime."""
        try:
            await submit(self._node, entry.newest)
        except RequestRefused as refused:
            log.debug("%s: %s", entry.newest.hash, refused)

    async def replace(self, entry: PendingTransaction) -> None:
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
        await self.send_again(entry)

    async def unblock(self, waiting: PendingTransaction) -> None:
        """Replace a transaction that has waited too long, or have the account's earlier nonces used.

        Many transactions may wait for the same nonces: one of them sees to these, each `Timing.replace_after`.
        """
        nonce = await self._node.transaction_count(self._account.address)
        if nonce == waiting.nonce:
            await self.replace(waiting)
        elif nonce < waiting.nonce and self._pending.may_unblock(self._node.timing.replace_after):
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
            gap = await self._node.transaction_count(self._account.address, block="pending")

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
                await (self.replace(sent) if is_first else self.send_again(sent))
            finally:
                self._pending.abandon(sent)
        return True

    async def _fill(self, nonce: int, waiting: PendingTransaction, *, was_missing: bool) -> bool:
        """Use a nonce that the node knows no transaction of, so that later ones can be mined; whether it was done.

        A reorganisation took the one that had it, and a restart made us forget it. Others of the account may still send
        it: nothing is filled before the first nonce was missing twice.
        """
        address = self._account.address
        if not was_missing or await self._node.transaction_count(address, block="pending") != nonce:
            self._pending.missing = nonce
            facts = {"tx": waiting.newest.hash, "nonce": nonce}
            waits = "%(tx)s waits for nonce %(nonce)d of its account, which no transaction of this program has"
            log.warning(waits, facts, extra=log_event("transaction-blocked", **facts))
            return False
        fields = waiting.fields | {"to": address, "data": "0x", "value": 0}
        signed = self._account.sign_transaction({**fields, "nonce": nonce})
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
