"""A connection to an Ethereum node: what is the same whatever contracts the chain holds."""

from __future__ import annotations

import asyncio
from functools import lru_cache
from typing import TYPE_CHECKING, Any, cast

from web3 import AsyncWeb3
from web3.exceptions import BadFunctionCallOutput

from mesh.chain.artifacts import load_artifact
from mesh.chain.errors import NoContracts
from mesh.chain.fees import FeePolicy
from mesh.chain.node_metrics import NodeMetrics
from mesh.chain.pending import PendingTransactions
from mesh.chain.provider import open_provider
from mesh.chain.timing import Timing
from mesh.chain.transaction_store import TransactionStore
from mesh.errors import ClosedError

if TYPE_CHECKING:
    from collections.abc import Iterable
    from pathlib import Path
    from types import TracebackType
    from typing import Self

    from eth_typing import ChecksumAddress
    from web3.contract import AsyncContract
    from web3.contract.async_contract import AsyncContractFunction
    from web3.types import BlockIdentifier

    from mesh.chain.provider import Endpoint

CONTRACTS_KEPT = 1024


class Node:
    """A node reached at `endpoint`: `http(s)://…`, `ws(s)://…` or a web3 provider object (which stays open).

    Several endpoints (a sequence, or one text with commas) are nodes of one chain: when one does not answer, the next
    is asked, and stays in use until it fails in its turn.

    `fees` is what its accounts pay at most. In the folder `journal`, where given, is written what they send: several
    processes of one account then never take the same number, and one that is started again takes up what it left.

    Used with `async with`, which connects: raises `NodeUnreachable` when nobody answers, `WrongChain` when one of
    several is on another chain. Making it raises `ConfigurationError` for a text that is no endpoint. Its methods raise
    `NodeUnreachable` when the node is lost, after bounded retries.
    """

    def __init__(
        self,
        endpoint: Endpoint,
        *,
        timing: Timing | None = None,
        fees: FeePolicy | None = None,
        journal: Path | None = None,
    ) -> None:
        self.timing = timing or Timing()
        self.fees = fees or FeePolicy()
        self._journal = journal
        self._chain_folder: Path | None = None
        self.tally = NodeMetrics()
        self._provider = open_provider(endpoint, self.timing, self.tally)
        self._chain_id: int | None = None
        self.web3: AsyncWeb3[Any] = AsyncWeb3(self._provider, middleware=[])
        self._outboxes: dict[str, PendingTransactions] = {}
        self.contract = lru_cache(maxsize=CONTRACTS_KEPT)(self._contract)

    @property
    def endpoint(self) -> str:
        """Where the node is, for people to read."""
        return self._provider.endpoint

    @property
    def chain_id(self) -> int:
        """EIP-155 number of the chain. Raises `ClosedError` before the connection."""
        if self._chain_id is None:
            raise ClosedError("the node is not connected: use it with `async with`")
        return self._chain_id

    async def __aenter__(self) -> Self:
        self._provider.open()
        try:
            self._chain_id = await self.web3.eth.chain_id
            await self._provider.check_chains(self._chain_id)
            if self._journal is not None:
                self._chain_folder = self._journal / await self._chain_name()
        except BaseException:
            await self._provider.close()
            raise
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self._chain_id = None
        await self._provider.close()

    async def block_number(self) -> int:
        """Number of the latest block."""
        return int(await self.web3.eth.block_number)

    async def eth_balance(self, address: str) -> int:
        """Wei of an account."""
        return int(await self.web3.eth.get_balance(self.checksum(address)))

    async def gas_price(self) -> int:
        """The price of a unit of gas now, wei."""
        return int(await self.web3.eth.gas_price)

    async def block_hash(self, number: int) -> bytes:
        """The 32-byte hash of a block."""
        return bytes((await self.web3.eth.get_block(number))["hash"])

    async def code(self, address: str) -> bytes:
        """The code of the contract at an address; empty if there is none."""
        return bytes(await self.web3.eth.get_code(self.checksum(address)))

    async def read(self, call: AsyncContractFunction, *, block: BlockIdentifier = "latest") -> Any:
        """What a contract's function returns. Raises `Reverted`, and `NoContracts` if there is no such contract."""
        try:
            return await call.call(block_identifier=block)
        except BadFunctionCallOutput:
            raise NoContracts(f"contract with {call.fn_name} at {call.address}", self.chain_id) from None

    async def read_all(self, calls: Iterable[AsyncContractFunction], *, block: BlockIdentifier) -> list[Any]:
        """What several functions return in the state of one block, asked at once. Raises as `read` does."""
        try:
            async with asyncio.TaskGroup() as group:
                tasks = [group.create_task(self.read(call, block=block)) for call in calls]
        except ExceptionGroup as failed:
            raise failed.exceptions[0] from None
        return [task.result() for task in tasks]

    def outbox(self, address: str) -> PendingTransactions:
        """What all senders of one account through this node share. Raises `ConfigurationError` for the journal."""
        if address not in self._outboxes:
            folder = self._chain_folder
            journal = None if folder is None else TransactionStore(folder / address.lower())
            self._outboxes[address] = PendingTransactions(journal)
        return self._outboxes[address]

    async def _chain_name(self) -> str:
        """A name that another chain of the same number (a development chain started afresh) does not have."""
        first = await self.web3.eth.get_block(0)
        return f"{self.chain_id}-{bytes(first['hash']).hex()[:16]}"

    def _contract(self, name: str, address: str) -> AsyncContract:
        """The contract at an address, with the ABI of one of ours (`artifacts.NAMES`); kept for the next time."""
        return self.web3.eth.contract(self.checksum(address), abi=load_artifact(name).abi)

    @staticmethod
    def checksum(address: str) -> ChecksumAddress:
        """An address as web3's types have it; ours are EIP-55 already."""
        return cast("ChecksumAddress", address)
