"""A connection to an Ethereum node: what is the same whatever contracts the chain holds."""

from __future__ import annotations

import asyncio
from functools import lru_cache
from typing import TYPE_CHECKING, Any, NamedTuple, cast

from web3 import AsyncWeb3
from web3.exceptions import BadFunctionCallOutput, BlockNotFound, TransactionNotFound

from mesh.chain.artifacts import load_artifact
from mesh.chain.errors import METHOD_NOT_FOUND, NoContracts, NodeUnreachable, RequestRefused
from mesh.chain.metrics import NodeMetrics
from mesh.chain.pending import PendingTransactions
from mesh.chain.policy import FeePolicy, Fees, GasMarket, Timing
from mesh.chain.transaction_store import TransactionStore
from mesh.chain.web3_provider import open_provider
from mesh.errors import ClosedError

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping
    from pathlib import Path
    from typing import Self

    from eth_typing import ChecksumAddress
    from hexbytes import HexBytes
    from web3.contract import AsyncContract
    from web3.contract.async_contract import AsyncContractFunction
    from web3.types import BlockIdentifier, FilterParams, RPCEndpoint, TxParams, TxReceipt

    from mesh.chain.web3_provider import Endpoint

CONTRACTS_KEPT = 1024


class BlockHeader(NamedTuple):
    """A block. Hashes are 32 bytes, `timestamp` is Unix time, `base_fee` is wei (None: the chain has none)."""

    number: int
    hash: bytes
    parent_hash: bytes
    timestamp: int
    base_fee: int | None


class Node:
    """A node reached at `endpoint`: `http(s)://…`, `ws(s)://…` or a web3 provider object (which stays open).

    Several endpoints (a sequence, or one text with commas) are nodes of one chain: when one does not answer, the next
    is asked, and stays in use until it fails in turn.

    `fees` is what its accounts pay at most. Transactions are recorded in the folder `transactions`, if given: then
    several processes of one account never use the same nonce, and one that is restarted continues what it began.

    Used with `async with`, which connects: raises `NodeUnreachable` when nobody answers, `WrongChain` when one of
    several is on another chain. Creating it raises `ConfigurationError` for a text that is not an endpoint. Its methods
    raise `NodeUnreachable` when the node is lost, after bounded retries, and `RequestRefused`.
    """

    def __init__(
        self,
        endpoint: Endpoint,
        *,
        timing: Timing | None = None,
        fees: FeePolicy | None = None,
        transactions: Path | None = None,
    ) -> None:
        self.timing = timing or Timing()
        self.fees = fees or FeePolicy()
        self.metrics = NodeMetrics()
        self._transactions = transactions
        self._chain_folder: Path | None = None
        self._provider = open_provider(endpoint, self.timing, self.metrics)
        self._chain_id: int | None = None
        self._web3: AsyncWeb3[Any] = AsyncWeb3(self._provider, middleware=[])
        self._pending: dict[str, PendingTransactions] = {}
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
            self._chain_id = await self._web3.eth.chain_id
            await self._provider.check_chains(self._chain_id)
            if self._transactions is not None:
                self._chain_folder = self._transactions / await self._chain_name()
        except BaseException:
            await self._provider.close()
            raise
        return self

    async def __aexit__(self, *exc_info: object) -> None:
        self._chain_id = None
        await self._provider.close()

    async def request(self, method: str, *params: Any) -> Any:
        """The result of any JSON-RPC method, as JSON."""
        response = await self._provider.make_request(cast("RPCEndpoint", method), list(params))
        return response["result"]

    async def client_version(self) -> str:
        """The name and version of the node's program."""
        return str(await self._web3.client_version)

    async def is_syncing(self) -> bool:
        """Whether the node says that it has not all blocks yet."""
        return bool(await self._web3.eth.syncing)

    async def block_number(self) -> int:
        """Number of the latest block."""
        return int(await self._web3.eth.block_number)

    async def header(self, number: int) -> BlockHeader | None:
        """A block; None if the chain does not have it."""
        return await self._header(number)

    async def latest_header(self) -> BlockHeader:
        """The latest block."""
        header = await self._header("latest")
        if header is None:
            raise NodeUnreachable(self.endpoint, "it has no blocks")
        return header

    async def block_hash(self, number: int) -> bytes:
        """The 32-byte hash of a block. Raises `NodeUnreachable` if the node does not have the block."""
        header = await self._header(number)
        if header is None:
            raise NodeUnreachable(self.endpoint, f"it has no block {number}")
        return header.hash

    async def logs(self, query: Mapping[str, Any]) -> list[Any]:
        """The logs that match an `eth_getLogs` query."""
        return list(await self._web3.eth.get_logs(cast("FilterParams", query)))

    async def eth_balance(self, address: str) -> int:
        """Wei of an account."""
        return int(await self._web3.eth.get_balance(self.checksum(address)))

    async def transaction_count(self, address: str, *, pending: bool = False) -> int:
        """How many transactions an account has on the chain; with `pending`, also those that wait to be mined."""
        return int(
            await self._web3.eth.get_transaction_count(self.checksum(address), "pending" if pending else "latest")
        )

    async def code(self, address: str) -> bytes:
        """The code of the contract at an address; empty if there is none."""
        return bytes(await self._web3.eth.get_code(self.checksum(address)))

    async def gas_price(self) -> int:
        """The price of a unit of gas that the node suggests, wei."""
        return int(await self._web3.eth.gas_price)

    async def gas_market(self) -> GasMarket:
        """The price of gas in the latest block, with the priority fee that the node suggests."""
        base = (await self.latest_header()).base_fee
        if base is None:
            price = await self.gas_price()
            return GasMarket(price, Fees(price, None))
        priority = await self._suggested_priority(base)
        return GasMarket(base + priority, Fees(2 * base + priority, priority))

    async def estimate_gas(self, call: TxParams) -> int:
        """Gas of a transaction in the state that pending ones leave. Raises `Reverted`."""
        return int(await self._web3.eth.estimate_gas(call, "pending"))

    async def call(self, call: TxParams, *, block: BlockIdentifier = "latest") -> bytes:
        """What a call returns in the state after a block. Raises `Reverted`."""
        return bytes(await self._web3.eth.call(call, block))

    async def send_raw(self, raw: bytes) -> None:
        """Give a signed transaction to the node, once."""
        await self._web3.eth.send_raw_transaction(raw)

    async def has_transaction(self, tx: str) -> bool:
        """Whether the node has a transaction, mined or waiting."""
        try:
            await self._web3.eth.get_transaction(cast("HexBytes", tx))
        except (TransactionNotFound, RequestRefused):
            return False
        return True

    async def receipt(self, tx: str) -> TxReceipt | None:
        """The receipt of a transaction; None if it is not mined."""
        try:
            return await self._web3.eth.get_transaction_receipt(cast("HexBytes", tx))
        except TransactionNotFound:
            return None

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

    def creation_code(self, name: str, *arguments: Any) -> bytes:
        """The data of a transaction that deploys one of our contracts (`artifacts.NAMES`)."""
        artifact = load_artifact(name)
        contract = self._web3.eth.contract(abi=artifact.abi, bytecode=artifact.bytecode)
        return bytes.fromhex(contract.constructor(*arguments).data_in_transaction[2:])

    def pending_transactions(self, address: str) -> PendingTransactions:
        """What all senders of one account through this node share. Raises `ConfigurationError` for the folder."""
        if address not in self._pending:
            folder = self._chain_folder
            store = None if folder is None else TransactionStore(folder / address.lower())
            self._pending[address] = PendingTransactions(store)
        return self._pending[address]

    async def _header(self, identifier: BlockIdentifier) -> BlockHeader | None:
        try:
            block = await self._web3.eth.get_block(identifier)
        except BlockNotFound:
            return None
        base_fee = block.get("baseFeePerGas")
        return BlockHeader(
            number=int(block["number"]),
            hash=bytes(block["hash"]),
            parent_hash=bytes(block["parentHash"]),
            timestamp=int(block["timestamp"]),
            base_fee=None if base_fee is None else int(base_fee),
        )

    async def _suggested_priority(self, base: int) -> int:
        """The priority fee that the node suggests, or how far its gas price is above the base fee."""
        try:
            return int(await self._web3.eth.max_priority_fee)
        except RequestRefused as refused:
            if refused.rpc_code != METHOD_NOT_FOUND:
                raise
            return max(await self.gas_price() - base, 0)

    async def _chain_name(self) -> str:
        """A name that another chain of the same number (a development chain that was restarted) does not have."""
        return f"{self.chain_id}-{(await self.block_hash(0)).hex()[:16]}"

    def contract_with_abi(self, address: str, abi: Any) -> AsyncContract:
        """The contract at an address with any ABI."""
        return self._web3.eth.contract(self.checksum(address), abi=abi)

    def _contract(self, name: str, address: str) -> AsyncContract:
        """The contract at an address with the ABI of one of ours (`artifacts.NAMES`); cached."""
        return self.contract_with_abi(address, load_artifact(name).abi)

    @staticmethod
    def checksum(address: str) -> ChecksumAddress:
        """An address as web3's types have it; ours are EIP-55 already."""
        return cast("ChecksumAddress", address)
