"""A connection to an Ethereum node: what is the same whatever contracts the chain holds."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Any, Final

from mesh.chain.abi import ContractFunctions, encode, our_functions
from mesh.chain.answers import ANSWERS, BlockHeader, InvalidAnswer
from mesh.chain.artifacts import load_artifact
from mesh.chain.errors import METHOD_NOT_FOUND, NodeUnreachable, RequestRefused
from mesh.chain.heads import Heads
from mesh.chain.metrics import NodeMetrics
from mesh.chain.multicall import read, read_all
from mesh.chain.pending import PendingTransactions
from mesh.chain.policy import FeePolicy, Fees, GasMarket, Timing
from mesh.chain.rpc_client import rpc_client
from mesh.chain.transaction_store import TransactionStore
from mesh.errors import ClosedError

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable, Mapping, Sequence
    from pathlib import Path
    from typing import Self

    from mesh.chain.abi import ContractCall
    from mesh.chain.answers import Log, MinedTransaction
    from mesh.chain.rpc_client import Endpoint

PRIORITY_SECONDS: Final = 60.0
"""How long the priority fee that the node suggests is used; the base fee is that of the latest block."""


class Node:
    """A node reached at `endpoint`: `http(s)://…`, `ws(s)://…` or a `Transport` (which stays open).

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
        self._rpc = rpc_client(endpoint, self.timing, self.metrics)
        self.heads = Heads(
            self._ask_latest, self.header, interval=self.timing.poll_interval, request_pushes=self._request_pushes
        )
        """The latest block, for all who wait for the next one."""
        self._priority = 0.0, 0
        self._chain_id: int | None = None
        self._pending: dict[str, PendingTransactions] = {}

    @property
    def endpoint(self) -> str:
        """Where the node is, for people to read."""
        return self._rpc.endpoint

    @property
    def chain_id(self) -> int:
        """EIP-155 number of the chain. Raises `ClosedError` before the connection."""
        if self._chain_id is None:
            raise ClosedError("the node is not connected: use it with `async with`")
        return self._chain_id

    async def __aenter__(self) -> Self:
        self._rpc.open()
        try:
            self._chain_id = int(await self._ask("eth_chainId"))
            await self._rpc.check_chains(self._chain_id)
            if self._transactions is not None:
                self._chain_folder = self._transactions / await self._chain_name()
        except BaseException:
            await self._rpc.close()
            raise
        return self

    async def __aexit__(self, *exc_info: object) -> None:
        self._chain_id = None
        await self._rpc.close()

    async def request(self, method: str, *params: Any) -> Any:
        """The result of any JSON-RPC method, as JSON."""
        return await self._rpc.request(method, list(params))

    async def client_version(self) -> str:
        """The name and version of the node's program."""
        return str(await self._ask("web3_clientVersion"))

    async def is_syncing(self) -> bool:
        """Whether the node says that it has not all blocks yet."""
        return bool(await self._ask("eth_syncing"))

    async def block_number(self) -> int:
        """Number of the latest block."""
        return int(await self._ask("eth_blockNumber"))

    async def header(self, block: int | str) -> BlockHeader | None:
        """A block, by its number or `latest`; None if the chain does not have it."""
        header: BlockHeader | None = await self._ask("eth_getBlockByNumber", _block(block), False)
        if header is not None and block not in ("latest", header.number):
            raise InvalidAnswer(f"eth_getBlockByNumber for {block}", f"it is block {header.number}")
        return header

    async def latest_header(self) -> BlockHeader:
        """The latest block, asked for now; `heads` has it without asking, where that is enough."""
        return await self.heads.look()

    async def _ask_latest(self) -> BlockHeader:
        """A null is asked again like any other spoiled answer: every chain has a latest block."""
        found: BlockHeader = await self._rpc.request("eth_getBlockByNumber", ["latest", False], kind=BlockHeader)
        return found

    async def block_hash(self, number: int) -> bytes:
        """The 32-byte hash of a block. Raises `NodeUnreachable` if the node does not have the block."""
        header = await self.header(number)
        if header is None:
            raise NodeUnreachable(self.endpoint, f"it has no block {number}")
        return header.hash

    async def logs(self, first: int, last: int, *, addresses: Collection[str], topics: Sequence[str]) -> list[Log]:
        """The logs of the blocks from `first` to `last`, both included, whose first topic is one of `topics`.

        Those of all contracts, unless `addresses` are given.
        """
        query: dict[str, Any] = {"fromBlock": hex(first), "toBlock": hex(last), "topics": [list(topics)]}
        if addresses:
            query["address"] = list(addresses)
        logs: list[Log] = await self._ask("eth_getLogs", query)
        if any(not first <= log.block_number <= last for log in logs):
            raise InvalidAnswer(f"eth_getLogs for the blocks {first} to {last}", "a log is of another block")
        return logs

    async def eth_balance(self, address: str) -> int:
        """Wei of an account."""
        return int(await self._ask("eth_getBalance", address, "latest"))

    async def transaction_count(self, address: str, *, block: int | str = "latest") -> int:
        """How many transactions an account has up to a block; for "pending" also those that wait to be mined."""
        return int(await self._ask("eth_getTransactionCount", address, _block(block)))

    async def code(self, address: str, *, block: int | str = "latest") -> bytes:
        """The code of the contract at an address, in the state after a block; empty if there is none."""
        return bytes(await self._ask("eth_getCode", address, _block(block)))

    async def gas_price(self) -> int:
        """The price of a unit of gas that the node suggests, wei."""
        return int(await self._ask("eth_gasPrice"))

    async def gas_market(self) -> GasMarket:
        """The price of gas in the latest block, with the priority fee that the node suggested of late."""
        head = await self.heads.recent()
        if head.base_fee is None:
            price = await self.gas_price()
            return GasMarket(price, Fees(price, None))
        until, priority = self._priority
        if time.monotonic() >= until:
            priority = await self._suggested_priority(head.base_fee)
            self._priority = time.monotonic() + PRIORITY_SECONDS, priority
        return GasMarket(head.base_fee + priority, Fees(2 * head.base_fee + priority, priority))

    async def estimate_gas(self, call: Mapping[str, Any]) -> int:
        """Gas of a transaction in the state that pending ones leave. Raises `Reverted`."""
        return int(await self._ask("eth_estimateGas", _call(call), "pending"))

    async def call(self, call: Mapping[str, Any], *, block: int | str = "latest") -> bytes:
        """What a call (`from`, `to`, `data`, `value`) returns in the state after a block. Raises `Reverted`."""
        return bytes(await self._ask("eth_call", _call(call), _block(block)))

    async def send_raw(self, raw: bytes) -> None:
        """Give a signed transaction to the node, once."""
        await self._ask("eth_sendRawTransaction", "0x" + raw.hex())

    async def has_transaction(self, tx: str) -> bool:
        """Whether the node has a transaction, mined or waiting."""
        try:
            return await self._ask("eth_getTransactionByHash", tx) is not None
        except RequestRefused:
            return False

    async def has_mined(self, tx: str) -> bool:
        """Whether the node has a transaction that waits, or was mined with success."""
        receipt = await self.receipt(tx)
        return await self.has_transaction(tx) if receipt is None else receipt.status == 1

    async def receipt(self, tx: str) -> MinedTransaction | None:
        """The receipt of a transaction; None if it is not mined."""
        receipt: MinedTransaction | None = await self._ask("eth_getTransactionReceipt", tx)
        return receipt

    async def read(self, call: ContractCall, *, block: int | str = "latest") -> Any:
        """What a contract's function returns, several values as a tuple; asked again if it does not decode.

        Raises `Reverted`, `NoContracts` if there is no such contract, `InvalidAnswer` for other data.
        """
        return await read(self, call, block=block)

    async def read_all(self, calls: Iterable[ContractCall], *, block: int | str) -> list[Any]:
        """What several functions return in the state of one block, asked for in one call. Raises as `read` does."""
        return await read_all(self, list(calls), block=block)

    def creation_code(self, name: str, *arguments: Any) -> bytes:
        """The data of a transaction that deploys one of our contracts (`artifacts.NAMES`)."""
        artifact = load_artifact(name)
        inputs = next((entry["inputs"] for entry in artifact.abi if entry["type"] == "constructor"), ())
        return artifact.bytecode + encode([member["type"] for member in inputs], arguments)

    def pending_transactions(self, address: str) -> PendingTransactions:
        """What all senders of one account through this node share. Raises `ConfigurationError` for the folder."""
        if address not in self._pending:
            folder = self._chain_folder
            store = None if folder is None else TransactionStore(folder / address.lower())
            self._pending[address] = PendingTransactions(store)
        return self._pending[address]

    async def _ask(self, method: str, *params: Any) -> Any:
        """What the node answers to one of the methods in `ANSWERS`, with the type that is declared there."""
        return await self._rpc.request(method, list(params), kind=ANSWERS[method])

    async def _suggested_priority(self, base: int) -> int:
        """The priority fee that the node suggests, or how far its gas price is above the base fee."""
        try:
            return int(await self._ask("eth_maxPriorityFeePerGas"))
        except RequestRefused as refused:
            if refused.rpc_code != METHOD_NOT_FOUND:
                raise
            return max(await self.gas_price() - base, 0)

    async def _chain_name(self) -> str:
        """A name that another chain of the same number (a development chain that was restarted) does not have."""
        return f"{self.chain_id}-{(await self.block_hash(0)).hex()[:16]}"

    def _request_pushes(self) -> None:
        self._rpc.push_heads(self.heads.pushed)

    def contract(self, name: str, address: str) -> ContractFunctions:
        """The functions of the contract at an address with the ABI of one of ours (`artifacts.NAMES`)."""
        return ContractFunctions(address, our_functions(name))


def _block(identifier: int | str) -> str:
    """A block as JSON-RPC has it: its number as a quantity, or a tag."""
    return identifier if isinstance(identifier, str) else hex(identifier)


def _call(call: Mapping[str, Any]) -> dict[str, Any]:
    """A call as JSON-RPC has it."""
    return {name: hex(member) if isinstance(member, int) else member for name, member in call.items()}
