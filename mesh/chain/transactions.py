"""Sending transactions: simulate, price, number, sign here, send raw, wait until mined.

The node never sees a key. A transaction that the contract would refuse is not sent at all: the estimate of its gas is
the simulation, and raises `Reverted`.
"""

from __future__ import annotations

import itertools
import logging
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final, cast

from mesh.chain.errors import InsufficientFunds, NodeUnreachable, RequestRefused, Reverted
from mesh.chain.node_metrics import TransactionOutcome
from mesh.chain.pending import Pending, PendingTransactions, effect_of
from mesh.chain.submission import (
    count_all,
    count_mined,
    find_receipt,
    is_known,
    is_number_taken,
    is_waiting_elsewhere,
    submit,
)
from mesh.chain.watching import NumberLost, Watch
from schemas.address import parse_address

if TYPE_CHECKING:
    from web3.contract.async_contract import AsyncContractFunction
    from web3.types import TxParams, TxReceipt

    from mesh.chain.accounts import Account, SignedTransaction
    from mesh.chain.node import Node

log = logging.getLogger(__name__)

GAS_MARGIN_PERCENT: Final = 20
"""Gas given above the estimate: the state may move on until the transaction is mined. What is not used is kept."""

NONCE_ATTEMPTS: Final = 25
"""How often a number that another client took meanwhile is replaced."""


@dataclass(frozen=True, slots=True)
class Receipt:
    """A mined transaction that went through. `contract` is what it deployed, if anything; logs as web3 gives them.

    `wei` is what its gas has cost.
    """

    tx: str
    block_number: int
    gas_used: int
    wei: int
    contract: str | None
    logs: tuple[Any, ...]


class TransactionSender:
    """Sends transactions of one account; safe to use from many tasks of one event loop at once.

    Transactions of one account through one node are numbered one after another under a lock; with the node's journal,
    so are those of all processes that share it. Without, other clients of the account get in each other's way, but
    not lost.

    A transaction whose outcome was not learned - its sender lost the node, gave up waiting or was cancelled, or its
    process ended, where there is a journal - is kept. Sending the same again (to the same, with the same data and
    value) takes it up instead of making a second one, as long as it is not mined, or not for longer than
    `Timing.repeat_within`. One that the node has forgotten meanwhile gives its number to the next.
    """

    def __init__(self, node: Node, account: Account) -> None:
        self.account = account
        self._node = node

    async def call(self, function: AsyncContractFunction) -> Receipt:
        """Send a call of a contract's function, and wait until it is mined. Raises as `send` does."""
        return await self.send(to=function.address, data=bytes.fromhex(function._encode_transaction_data()[2:]))

    async def send(self, *, to: str | None, data: bytes, value: int = 0) -> Receipt:
        """Send `data` and `value` (wei) to an address, or deploy `data` where `to` is None; wait until it is mined.

        Raises `Reverted` (before anything is sent, or once it is mined and failed), `InsufficientFunds`, `FeeTooHigh`
        (nothing was sent), `TransactionTimeout`, `NodeUnreachable`, `RequestRefused`.
        """
        outbox = self._node.outbox(self.account.address)
        fields: dict[str, Any] = {"to": to or b"", "data": "0x" + data.hex(), "value": value}
        while True:
            entry = await self._taken_up(outbox, fields) or await self._sent(outbox, fields)
            try:
                signed, receipt = await Watch(self._node, self.account, outbox, entry).mined()
                await outbox.forget(entry)
            except NumberLost:
                log.info("the number %d was another transaction's; sending with the next", entry.nonce)
                await outbox.forget(entry)
                self._node.tally.count(TransactionOutcome.LOST)
                continue
            finally:
                outbox.abandon(entry)
            went_through = receipt["status"] == 1
            self._node.tally.count(TransactionOutcome.MINED if went_through else TransactionOutcome.FAILED)
            self._node.tally.paid(gas_used=int(receipt["gasUsed"]), wei=_wei(receipt))
            if not went_through:
                raise await self._why_failed(entry.fields, receipt)
            return _receipt(signed, receipt)

    async def _taken_up(self, outbox: PendingTransactions, fields: dict[str, Any]) -> Pending | None:
        """The transaction that was sent before to the same effect, and that nobody watches; None if there is none."""
        async with outbox.lock:
            await outbox.refresh()
            if not outbox.abandoned:
                return None
            mined = await count_mined(self._node, self.account.address)
            for entry in outbox.abandoned:
                if entry.nonce < mined and entry.sent_at + self._node.timing.repeat_within < time.time():
                    await outbox.forget(entry)
                elif entry.effect == effect_of(fields) and await self._is_alive(entry) and await outbox.take_up(entry):
                    log.info("the transaction %s was sent before; waiting for it", entry.versions[-1].hash)
                    return entry
        return None

    async def _is_alive(self, entry: Pending) -> bool:
        """Whether a transaction is mined or can be, once the node has it (again)."""
        if await find_receipt(self._node, reversed(entry.versions)) is not None:
            return True
        try:
            await submit(self._node, entry.versions[-1])
        except RequestRefused:
            return await is_known(self._node, entry.versions)
        return True

    async def _sent(self, outbox: PendingTransactions, fields: dict[str, Any]) -> Pending:
        """The transaction, simulated, priced and sent."""
        gas = await self._estimate(fields)
        limit = gas + gas * GAS_MARGIN_PERCENT // 100
        fees = await self._node.fees.fees(self._node)
        complete = fields | fees.fields() | {"gas": limit, "chainId": self._node.chain_id}
        async with outbox.lock:
            return await self._send_numbered(outbox, complete)

    async def _estimate(self, fields: dict[str, Any]) -> int:
        """Gas in the state that the account's own pending transactions leave."""
        try:
            return int(await self._node.web3.eth.estimate_gas(self._call(fields), "pending"))
        except RequestRefused as refused:
            await self._raise_if_poor(fields, refused)
            raise
        except Reverted:
            self._node.tally.count(TransactionOutcome.REFUSED)
            raise

    async def _send_numbered(self, outbox: PendingTransactions, fields: dict[str, Any]) -> Pending:
        """Sign with the next number and send; again where another client was faster."""
        refused_numbers: set[int] = set()
        for attempt in range(1, NONCE_ATTEMPTS + 1):
            nonce = await self._next_nonce(outbox, refused_numbers)
            signed = self.account.sign_transaction(fields | {"nonce": nonce})
            entry = Pending(nonce=nonce, fields=fields, versions=[signed])
            if not await outbox.add(entry):
                continue
            try:
                await submit(self._node, signed)
            except RequestRefused as refused:
                await outbox.forget(entry)
                await self._raise_if_poor(fields, refused)
                if attempt == NONCE_ATTEMPTS or not is_number_taken(refused):
                    raise
                if is_waiting_elsewhere(refused):
                    refused_numbers.add(nonce)
                log.debug("%s: the number %d was taken; trying the next", self.account.address, nonce)
            except BaseException:
                # It may have arrived.
                outbox.abandon(entry)
                raise
            else:
                self._node.tally.count(TransactionOutcome.SENT)
                return entry
        raise NodeUnreachable(self._node.endpoint, "other clients of the account take all its numbers")

    async def _next_nonce(self, outbox: PendingTransactions, refused: set[int]) -> int:
        """The first number that no transaction has, of those that the node knows and of those sent by us."""
        await outbox.refresh()
        counted = await count_all(self._node, self.account.address)
        # A node behind a balancer may not have heard of what was just sent through another.
        left = [entry.nonce for entry in outbox.abandoned if await self._is_waiting(entry, counted)]
        taken = {*outbox.taken, *left, *refused}
        return next(number for number in itertools.count(counted) if number not in taken)

    async def _is_waiting(self, entry: Pending, counted: int) -> bool:
        return entry.nonce >= counted and await is_known(self._node, entry.versions)

    async def _raise_if_poor(self, fields: dict[str, Any], refused: RequestRefused) -> None:
        balance = await self._node.eth_balance(self.account.address)
        needed = fields.get("gas", 0) * fields.get("maxFeePerGas", fields.get("gasPrice", 0)) + fields["value"]
        if balance < needed:
            raise InsufficientFunds(self.account.address, balance=balance, needed=needed) from refused

    async def _why_failed(self, fields: dict[str, Any], receipt: TxReceipt) -> Reverted:
        """Why a mined transaction failed though its simulation went through: asked of the state after its block."""
        gas_used, wei = int(receipt["gasUsed"]), _wei(receipt)
        try:
            await self._node.web3.eth.call(self._call(fields), receipt["blockNumber"])
        except Reverted as why:
            return Reverted(why.reason, arguments=why.arguments, data=why.data, gas_used=gas_used, wei=wei)
        except RequestRefused as refused:
            return Reverted(refused.detail, gas_used=gas_used, wei=wei)
        return Reverted("OutOfGas" if gas_used >= fields["gas"] else "", gas_used=gas_used, wei=wei)

    def _call(self, fields: dict[str, Any]) -> TxParams:
        """The same as a call, without prices: a simulation is not paid for."""
        call = {"from": self.account.address, "data": fields["data"], "value": fields["value"]}
        return cast("TxParams", call | ({"to": fields["to"]} if fields["to"] else {}))


def _receipt(signed: SignedTransaction, receipt: TxReceipt) -> Receipt:
    contract = receipt["contractAddress"]
    return Receipt(
        tx=signed.hash,
        block_number=int(receipt["blockNumber"]),
        gas_used=int(receipt["gasUsed"]),
        wei=_wei(receipt),
        contract=None if contract is None else parse_address(contract),
        logs=tuple(receipt["logs"]),
    )


def _wei(receipt: TxReceipt) -> int:
    """What a mined transaction's gas has cost."""
    return int(receipt["gasUsed"]) * int(receipt["effectiveGasPrice"])
