"""A whole Ethereum node in this process: py-evm as eth-tester sets it up, behind JSON-RPC methods.

A transaction is mined at once into a block of its own, so there is no pool, no reorganisation and no "pending" state
apart from the latest. Calls and estimates run in the next block, where a transaction would land.

eth-tester's own front end is not used: it looks through the whole chain for each receipt, gives reverts as printed
Python bytes, and speaks no JSON-RPC.

One thread may change the chain while others read it and run calls: a block counts only when it is complete, and each
run has a state of its own.
"""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Any, Final

from eth_tester import PyEVMBackend  # type: ignore[import-untyped]
from eth_tester.exceptions import BlockNotFound  # type: ignore[import-untyped]
from eth_utils.exceptions import ValidationError

from mesh.devchain.bounded_vm import GAS_LIMIT, BoundedVM, bounded
from mesh.devchain.calls import Calls
from mesh.devchain.jsonrpc import INVALID_PARAMS, SERVER_ERROR, RpcError, to_json

if TYPE_CHECKING:
    from collections.abc import Iterator

    from eth.abc import SignedTransactionAPI

MNEMONIC: Final = "test test test test test test test test test test test junk"
"""The phrase that development chains share (anvil, hardhat): its keys are public, and worth nothing elsewhere."""

DERIVATION_PATH: Final = "m/44'/60'/0'/0"
FUNDED_KEYS: Final = 10
FUNDS_WEI: Final = 1_000_000 * 10**18
MAX_MINED_BLOCKS: Final = 1_000
"""Empty blocks that one request may mine."""
PRIORITY_FEE_WEI: Final = 1


class Evm:
    """The state of the chain. Heights are block numbers; amounts are wei.

    A run that computes for more than `run_seconds` and a query that finds more than `max_logs` raise `RpcError`.
    """

    def __init__(self, *, run_seconds: float, max_logs: int) -> None:
        self._backend = PyEVMBackend.from_mnemonic(
            MNEMONIC,
            genesis_state_overrides={"balance": FUNDS_WEI},
            num_accounts=FUNDED_KEYS,
            hd_path=DERIVATION_PATH,
            genesis_parameters=PyEVMBackend.generate_genesis_params({"gas_limit": GAS_LIMIT}),
        )
        type(self._backend.chain).vm_configuration = ((0, BoundedVM),)
        self._run_seconds = run_seconds
        self.calls = Calls(self._backend.chain, run_seconds=run_seconds)
        self.max_logs = max_logs
        self.head = 0
        """Number of the latest block."""

        self._receipts: dict[bytes, dict[str, Any]] = {}
        self._transactions: dict[bytes, dict[str, Any]] = {}
        self._logs: dict[int, list[dict[str, Any]]] = {}

    @property
    def funded_keys(self) -> tuple[bytes, ...]:
        """Private keys of the accounts that the first block gave `FUNDS_WEI` each."""
        return tuple(key.to_bytes() for key in self._backend.account_keys)

    @property
    def chain_id(self) -> int:
        """EIP-155 number of the chain."""
        return int(self._backend.chain.chain_id)

    @property
    def base_fee(self) -> int:
        """Base fee of the next block, wei a gas."""
        return int(self._backend.chain.header.base_fee_per_gas)

    def height(self, tag: object) -> int:
        """The block number behind a tag (`latest`, …) or a number. Raises `RpcError` for a missing block."""
        match tag:
            case "latest" | "pending" | "safe" | "finalized":
                return self.head
            case "earliest":
                return 0
            case int() if 0 <= tag <= self.head:
                return tag
        raise RpcError(SERVER_ERROR, f"block {tag!r} not found; the latest is {self.head}")

    def balance(self, address: bytes, height: int) -> int:
        """Wei of an account."""
        return int(self._backend.get_balance(address, height))

    def nonce(self, address: bytes, height: int) -> int:
        """Number of transactions that an account has sent."""
        return int(self._backend.get_nonce(address, height))

    def code(self, address: bytes, height: int) -> bytes:
        """A contract's code, empty for an account."""
        return bytes(self._backend.get_code(address, height))

    def storage(self, address: bytes, slot: int, height: int) -> bytes:
        """A storage slot, 32 bytes."""
        value = self._backend.get_storage(address, slot, height)
        return (value if isinstance(value, bytes) else value.to_bytes(32, "big")).rjust(32, b"\0")

    def block(self, identifier: int | bytes, *, transactions: str) -> dict[str, Any] | None:
        """A block by number or hash, None if there is none; its `transactions` as `"hashes"` or as `"objects"`."""
        if isinstance(identifier, int) and identifier > self.head:
            return None
        get = self._backend.get_block_by_hash if isinstance(identifier, bytes) else self._backend.get_block_by_number
        try:
            raw = get(identifier, full_transaction=False)
        except BlockNotFound:
            return None
        block: dict[str, Any] = to_json(raw)
        block["miner"] = block.pop("coinbase")
        block["logsBloom"] = f"0x{raw['logs_bloom']:0512x}"
        if transactions == "objects":
            block["transactions"] = [self._transactions[hash_] for hash_ in raw["transactions"]]
        return block

    def transaction(self, hash_: bytes) -> dict[str, Any] | None:
        """A mined transaction, None if there is none."""
        return self._transactions.get(hash_)

    def receipt(self, hash_: bytes) -> dict[str, Any] | None:
        """The receipt of a mined transaction, None if there is none."""
        return self._receipts.get(hash_)

    def logs(self, first: int, last: int) -> Iterator[dict[str, Any]]:
        """All logs of the blocks from `first` to `last`, both included, in order."""
        for height in range(first, min(last, self.head) + 1):
            yield from self._logs.get(height, ())

    def mine(self, blocks: int) -> None:
        """Mine empty blocks. Raises `RpcError` for more than `MAX_MINED_BLOCKS`."""
        if blocks > MAX_MINED_BLOCKS:
            raise RpcError(INVALID_PARAMS, f"at most {MAX_MINED_BLOCKS} blocks are mined at once")
        for _ in range(blocks):
            self._set_clock()
            self._mine_block()

    def rewind(self, height: int) -> None:
        """Remove all blocks after one. Raises `RpcError` if there is no such block."""
        block = self._backend.get_block_by_number(self.height(height), full_transaction=False)
        self.head = height
        self._backend.revert_to_snapshot(bytes(block["hash"]))
        gone = [hash_ for hash_, receipt in self._receipts.items() if int(receipt["blockNumber"], 16) > height]
        for hash_ in gone:
            del self._receipts[hash_], self._transactions[hash_]
        self._logs = {number: logs for number, logs in self._logs.items() if number <= height}

    def send(self, raw: bytes) -> bytes:
        """Apply a signed transaction and mine its block; its hash. Raises `RpcError` for one that no block can hold."""
        chain = self._backend.chain
        try:
            transaction = chain.get_vm().get_transaction_builder().decode(raw)
            sender = bytes(transaction.sender)
        except Exception as error:
            raise RpcError(SERVER_ERROR, f"the transaction can't be decoded: {error}") from None
        if transaction.hash in self._receipts:
            raise RpcError(SERVER_ERROR, "already known")
        self._check(transaction, sender)
        self._set_clock()
        try:
            with bounded(self._run_seconds):
                self._backend.send_raw_transaction(raw)
        except ValidationError as error:
            raise RpcError(SERVER_ERROR, str(error)) from None
        self._mine_block(bytes(transaction.hash))
        return bytes(transaction.hash)

    def _mine_block(self, transaction: bytes | None = None) -> None:
        """Mine a block, with the transaction that was applied. Others see it when all about it is known."""
        self._backend.mine_blocks(1)
        height = int(self._backend.chain.header.block_number) - 1
        if transaction is not None:
            self._remember(transaction, height)
        self.head = height

    def _check(self, transaction: SignedTransactionAPI, sender: bytes) -> None:
        """Refuse an invalid transaction with geth's error messages instead of py-evm's."""
        if transaction.gas > GAS_LIMIT:
            raise RpcError(SERVER_ERROR, "exceeds block gas limit")
        expected = self.nonce(sender, self.head)
        if transaction.nonce != expected:
            which = "low" if transaction.nonce < expected else "high"
            raise RpcError(SERVER_ERROR, f"nonce too {which}: next nonce {expected}, tx nonce {transaction.nonce}")
        price = getattr(transaction, "max_fee_per_gas", None) or transaction.gas_price
        wanted, funds = transaction.gas * price + transaction.value, self.balance(sender, self.head)
        if wanted > funds:
            raise RpcError(SERVER_ERROR, f"insufficient funds for gas * price + value: have {funds} want {wanted}")

    def _remember(self, hash_: bytes, height: int) -> None:
        receipt = to_json(self._backend.get_transaction_receipt(hash_))
        receipt["to"] = None if receipt["to"] == "0x" else receipt["to"]
        receipt["logsBloom"] = self._logs_bloom()
        for log in receipt["logs"]:
            del log["type"]
            log["removed"] = False
        transaction = to_json(self._backend.get_transaction_by_hash(hash_))
        transaction["input"] = transaction.pop("data")
        transaction["to"] = receipt["to"]
        self._transactions[hash_] = transaction
        self._receipts[hash_] = receipt
        if receipt["logs"]:
            self._logs[height] = receipt["logs"]

    def _logs_bloom(self) -> str:
        header = self._backend.chain.get_canonical_head()
        return f"0x{int(header.bloom):0512x}"

    def _set_clock(self) -> None:
        """Set the time of the next block to now; py-evm fixed it when the previous block was mined."""
        chain = self._backend.chain
        chain.set_header_timestamp(max(int(time.time()), int(chain.header.timestamp)))
