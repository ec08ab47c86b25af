"""Sending transactions: simulate, price, number, sign here, send raw, wait until mined.

The node never sees a key. A transaction that the contract would refuse is not sent at all: the estimate of its gas is
the simulation, and raises `Reverted`.
"""

from __future__ import annotations

import asyncio
import logging
from contextlib import asynccontextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final, cast

from web3.exceptions import TransactionNotFound

from mesh.chain.errors import InsufficientFunds, NodeUnreachable, RequestRefused, Reverted, TransactionTimeout
from schemas.address import parse_address

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    from hexbytes import HexBytes
    from web3.contract.async_contract import AsyncContractFunction
    from web3.types import TxParams, TxReceipt

    from mesh.chain.accounts import Account, SignedTransaction
    from mesh.chain.node import Node

log = logging.getLogger(__name__)

GAS_MARGIN_PERCENT: Final = 20
"""Gas given above the estimate: the state may move on until the transaction is mined. What is not used is kept."""

NONCE_ATTEMPTS: Final = 25
"""How often a number that another client took meanwhile is replaced."""

NUMBER_TAKEN: Final = (
    "nonce too low",
    "nonce too high",
    "underpriced",
    "already known",
    "known transaction",
    "already imported",
    "alreadyknown",
    "oldnonce",
)
"""Words of geth, anvil, nethermind, erigon and the embedded chain for a number that is another transaction's."""


@dataclass(frozen=True, slots=True)
class Receipt:
    """A mined transaction that went through. `contract` is what it deployed, if anything; logs as web3 gives them."""

    tx: str
    block_number: int
    gas_used: int
    contract: str | None
    logs: tuple[Any, ...]


@dataclass(frozen=True, slots=True)
class Fees:
    """Prices of a unit of gas, in wei (EIP-1559), or the one price of a chain without a base fee."""

    maximum: int
    priority: int | None

    def fields(self) -> dict[str, int]:
        """The transaction's fields."""
        if self.priority is None:
            return {"gasPrice": self.maximum}
        return {"type": 2, "maxFeePerGas": self.maximum, "maxPriorityFeePerGas": self.priority}


class Sender:
    """Sends transactions of one account; safe to use from many tasks of one event loop at once.

    Transactions of one account through one node are numbered one after another under a lock. Other clients of the
    same account get in each other's way, but not lost on a node that refuses a number twice. Cancelling `send` after
    the transaction went out does not take it back.
    """

    def __init__(self, node: Node, account: Account) -> None:
        self.account = account
        self._node = node
        self._numbering = node.numbering(account.address)

    async def call(self, function: AsyncContractFunction) -> Receipt:
        """Send a call of a contract's function, and wait until it is mined. Raises as `send` does."""
        return await self.send(to=function.address, data=bytes.fromhex(function._encode_transaction_data()[2:]))

    async def send(self, *, to: str | None, data: bytes, value: int = 0) -> Receipt:
        """Send `data` and `value` (wei) to an address, or deploy `data` where `to` is None; wait until it is mined.

        Raises `Reverted` (before anything is sent, or once it is mined and failed), `InsufficientFunds`,
        `TransactionTimeout`, `NodeUnreachable`, `RequestRefused`.
        """
        fields: dict[str, Any] = {"from": self.account.address, "data": "0x" + data.hex(), "value": value}
        if to is not None:
            fields["to"] = to
        gas = await self._estimate(fields)
        limit = gas + gas * GAS_MARGIN_PERCENT // 100
        fees = await self._fees()
        async with self._sent(fields | fees.fields() | {"gas": limit, "chainId": self._node.chain_id}) as signed:
            receipt = await self._mined(signed)
        if receipt["status"] != 1:
            raise await self._why_failed(fields, receipt, limit)
        return _receipt(signed, receipt)

    async def _estimate(self, fields: dict[str, Any]) -> int:
        """Gas in the state that the account's own pending transactions leave."""
        try:
            return int(await self._node.web3.eth.estimate_gas(cast("TxParams", fields), "pending"))
        except RequestRefused as refused:
            await self._raise_if_poor(fields, refused)
            raise

    async def _fees(self) -> Fees:
        eth = self._node.web3.eth
        base = (await eth.get_block("latest")).get("baseFeePerGas")
        if base is None:
            return Fees(maximum=int(await eth.gas_price), priority=None)
        priority = int(await eth.max_priority_fee)
        return Fees(maximum=2 * int(base) + priority, priority=priority)

    @asynccontextmanager
    async def _sent(self, fields: dict[str, Any]) -> AsyncIterator[SignedTransaction]:
        """The transaction, sent; its number counts as taken inside the block."""
        async with self._numbering.lock:
            nonce, signed = await self._send_numbered({**fields, "to": fields.get("to", b"")})
            self._numbering.in_flight.add(nonce)
        try:
            yield signed
        finally:
            self._numbering.in_flight.discard(nonce)

    async def _send_numbered(self, fields: dict[str, Any]) -> tuple[int, SignedTransaction]:
        """Sign with the next number and send; again where another client was faster."""
        unsigned = {name: value for name, value in fields.items() if name != "from"}
        attempt = 1
        while True:
            nonce = await self._next_nonce()
            signed = self.account.sign_transaction(unsigned | {"nonce": nonce})
            try:
                await self._submit(signed)
            except RequestRefused as refused:
                await self._raise_if_poor(fields, refused)
                if attempt == NONCE_ATTEMPTS or not any(word in refused.detail.lower() for word in NUMBER_TAKEN):
                    raise
                log.debug("%s: the number %d was taken; trying the next", self.account.address, nonce)
                attempt += 1
            else:
                return nonce, signed

    async def _submit(self, signed: SignedTransaction) -> None:
        """Give the transaction to the node, again where the connection fails.

        Once an attempt may have arrived, a refusal of the next can mean just that.
        """
        timing = self._node.timing
        delay, may_have_arrived = timing.retry_delay, False
        for attempt in range(1, timing.attempts + 1):
            try:
                await self._node.web3.eth.send_raw_transaction(signed.raw)
            except NodeUnreachable:
                if attempt == timing.attempts:
                    raise
                may_have_arrived = True
                await asyncio.sleep(delay)
                delay *= 2
            except RequestRefused:
                if may_have_arrived and await self._is_known(signed):
                    return
                raise
            else:
                return

    async def _next_nonce(self) -> int:
        address = self._node.checksum(self.account.address)
        counted = int(await self._node.web3.eth.get_transaction_count(address, "pending"))
        # A node behind a balancer may not have heard of what was just sent through another.
        return max(counted, 0, *(nonce + 1 for nonce in self._numbering.in_flight))

    async def _is_known(self, signed: SignedTransaction) -> bool:
        """Whether the node has the transaction after all: its first answer was lost, and this was another attempt."""
        try:
            await self._node.web3.eth.get_transaction(_hash(signed))
        except (TransactionNotFound, RequestRefused):
            return False
        return True

    async def _raise_if_poor(self, fields: dict[str, Any], refused: RequestRefused) -> None:
        balance = await self._node.eth_balance(self.account.address)
        needed = fields.get("gas", 0) * fields.get("maxFeePerGas", fields.get("gasPrice", 0)) + fields["value"]
        if balance < needed:
            raise InsufficientFunds(self.account.address, balance=balance, needed=needed) from refused

    async def _mined(self, signed: SignedTransaction) -> TxReceipt:
        """The receipt, looked for until it is there."""
        timing = self._node.timing
        pause = min(timing.receipt_interval, timing.poll_interval)
        try:
            async with asyncio.timeout(timing.receipt_timeout):
                while True:
                    try:
                        return await self._node.web3.eth.get_transaction_receipt(_hash(signed))
                    except TransactionNotFound:
                        await asyncio.sleep(pause)
                        pause = min(pause * 1.5, timing.poll_interval)
        except TimeoutError:
            raise TransactionTimeout(signed.hash, timing.receipt_timeout) from None

    async def _why_failed(self, fields: dict[str, Any], receipt: TxReceipt, limit: int) -> Reverted:
        """Why a mined transaction failed though its simulation went through: asked of the state after its block."""
        try:
            await self._node.web3.eth.call(cast("TxParams", fields), receipt["blockNumber"])
        except Reverted as reverted:
            return reverted
        except RequestRefused as refused:
            return Reverted(refused.detail)
        return Reverted("OutOfGas" if receipt["gasUsed"] >= limit else "")


def _hash(signed: SignedTransaction) -> HexBytes:
    return cast("HexBytes", signed.hash)


def _receipt(signed: SignedTransaction, receipt: TxReceipt) -> Receipt:
    contract = receipt["contractAddress"]
    return Receipt(
        tx=signed.hash,
        block_number=int(receipt["blockNumber"]),
        gas_used=int(receipt["gasUsed"]),
        contract=None if contract is None else parse_address(contract),
        logs=tuple(receipt["logs"]),
    )
