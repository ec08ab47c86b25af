"""Giving signed transactions to a node, and asking it what has become of them."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Final, cast

from web3.exceptions import TransactionNotFound

from mesh.chain.errors import NodeUnreachable, RequestRefused

if TYPE_CHECKING:
    from collections.abc import Iterable

    from hexbytes import HexBytes
    from web3.types import TxReceipt

    from mesh.chain.accounts import SignedTransaction
    from mesh.chain.node import Node

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


def is_number_taken(refused: RequestRefused) -> bool:
    """Whether a node refused a transaction because of its number."""
    return any(word in refused.detail.lower() for word in NUMBER_TAKEN)


def is_waiting_elsewhere(refused: RequestRefused) -> bool:
    """Whether it did so as another transaction with the number waits, perhaps without counting it."""
    return is_number_taken(refused) and "nonce" not in refused.detail.lower()


async def submit(node: Node, signed: SignedTransaction) -> None:
    """Give a transaction to the node, again where the connection fails: the same bytes never count twice.

    Once an attempt may have arrived, a refusal of the next can mean just that. Raises `NodeUnreachable`,
    `RequestRefused`.
    """
    timing = node.timing
    delay, may_have_arrived = timing.retry_delay, False
    for attempt in range(1, timing.attempts + 1):
        try:
            await node.web3.eth.send_raw_transaction(signed.raw)
        except NodeUnreachable:
            if attempt == timing.attempts:
                raise
            may_have_arrived = True
            await asyncio.sleep(delay)
            delay *= 2
        except RequestRefused:
            if may_have_arrived and await is_known(node, [signed]):
                return
            raise
        else:
            return


async def is_known(node: Node, versions: Iterable[SignedTransaction]) -> bool:
    """Whether the node has one of the versions of a transaction, mined or waiting."""
    for signed in versions:
        try:
            await node.web3.eth.get_transaction(_hash(signed))
        except (TransactionNotFound, RequestRefused):
            continue
        return True
    return False


async def find_receipt(node: Node, versions: Iterable[SignedTransaction]) -> tuple[SignedTransaction, TxReceipt] | None:
    """The version of a transaction that was mined, and its receipt; None if none was."""
    for signed in versions:
        try:
            return signed, await node.web3.eth.get_transaction_receipt(_hash(signed))
        except TransactionNotFound:
            continue
    return None


async def count_mined(node: Node, address: str) -> int:
    """How many transactions an account has on the chain: the number of the next one."""
    return int(await node.web3.eth.get_transaction_count(node.checksum(address), "latest"))


async def count_all(node: Node, address: str) -> int:
    """The same with those that the node knows to be waiting."""
    return int(await node.web3.eth.get_transaction_count(node.checksum(address), "pending"))


def _hash(signed: SignedTransaction) -> HexBytes:
    return cast("HexBytes", signed.hash)
