"""A whole Ethereum node in this process: py-evm as eth-tester sets it up, behind JSON-RPC methods.

A transaction is mined at once into a block of its own, so there is no pool, no reorganisation and no "pending" state
apart from the latest. Calls and estimates run in the next block, where a transaction would land, and their changes are
forgotten. The time of one run is limited: py-evm needs ten seconds and more for the gas of one block. Code without end
has to jump or to call, so time is checked there. The methods are enough for this project's clients, web3.py, ethers and
both legacy JavaScript clients, which also send transactions of the accounts that the first block funded.

eth-tester's own front end is not used: it looks through the whole chain for each receipt, gives reverts as printed
Python bytes, and speaks no JSON-RPC.

One thread may change the chain while others read it and run calls: a block counts only when it is complete, and each
run has a state of its own.
"""

from __future__ import annotations

import threading
import time
from collections import OrderedDict
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import islice
from typing import TYPE_CHECKING, Any, Final

from eth._utils.address import force_bytes_to_address
from eth.constants import GAS_JUMPDEST
from eth.exceptions import Revert
from eth.vm import mnemonics, opcode_values
from eth.vm.forks.prague import PragueVM
from eth.vm.forks.prague.computation import PragueComputation
from eth.vm.forks.prague.state import PragueState
from eth.vm.opcode import as_opcode
from eth.vm.spoof import SpoofTransaction
from eth_account import Account as EthAccount
from eth_account.messages import encode_defunct
from eth_tester import PyEVMBackend  # type: ignore[import-untyped]
from eth_tester.exceptions import BlockNotFound  # type: ignore[import-untyped]
from eth_utils.exceptions import ValidationError

from mesh.base.flood import forget_oldest
from mesh.chain import Account
from mesh.chain.answers import REVERTED
from mesh.chain.errors import METHOD_NOT_FOUND
from mesh.dev._rpc import (
    LogFilter,
    RpcCode,
    RpcError,
    parse_data,
    parse_quantity,
    to_json,
)
from schemas import keccak256
from schemas.address import address_bytes

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    from eth.abc import BlockHeaderAPI, ChainAPI, ComputationAPI, SignedTransactionAPI


GAS_LIMIT: Final = 30_000_000
"""Gas that a block may use, and a call."""


SLOW_PRECOMPILES: Final = (0x08, 0x0C, 0x0E, 0x0F)
"""Pairings and sums over elliptic curves, which take a second for each pair and can't be interrupted."""


class _RunTooLong(Exception):
    """A run used up its time. Not an error of the EVM: it ends the outermost run."""


class _Limit(threading.local):
    """The limit of the run in this thread."""

    deadline: float | None = None
    """As `time.thread_time` counts: a busy machine does not shorten a run."""
    checks: int = 0
    """Jumps and calls so far."""


_limit: Final = _Limit()


@contextmanager
def bounded(seconds: float) -> Iterator[None]:
    """End a run of the body once this thread has computed for that many seconds. Raises `RpcError` then, as geth."""
    _limit.deadline = time.thread_time() + seconds
    try:
        yield
    except _RunTooLong:
        raise RpcError(RpcCode.SERVER_ERROR, f"execution aborted (timeout = {seconds:g}s)") from None
    finally:
        _limit.deadline = None


def _check_time(computation: object = None) -> None:
    """End a run whose time is over. It looks at one of 64 jumps and calls: reading a thread's clock costs as much as a
    few opcodes."""
    _limit.checks += 1
    if _limit.checks % 64 == 0 and _limit.deadline is not None and time.thread_time() > _limit.deadline:
        raise _RunTooLong


def _bounded_input(precompile: Callable[[ComputationAPI], Any]) -> Callable[[ComputationAPI], Any]:
    def run(computation: ComputationAPI) -> Any:
        if len(computation.msg.data) > 1_536:  # eight pairs on bn128, four on BLS12-381
            raise _RunTooLong
        return precompile(computation)

    return run


PRECOMPILES: Final = dict(PragueComputation.get_precompiles())
for _number in SLOW_PRECOMPILES:
    _address = force_bytes_to_address(bytes([_number]))
    PRECOMPILES[_address] = _bounded_input(PRECOMPILES[_address])


class _BoundedComputation(PragueComputation):
    opcodes = PragueComputation.opcodes | {
        opcode_values.JUMPDEST: as_opcode(logic_fn=_check_time, mnemonic=mnemonics.JUMPDEST, gas_cost=GAS_JUMPDEST)
    }

    _precompiles = PRECOMPILES

    @classmethod
    def apply_computation(cls, *args: Any, **kwargs: Any) -> ComputationAPI:
        _check_time()
        return super().apply_computation(*args, **kwargs)


class _BoundedState(PragueState):
    computation_class = _BoundedComputation


class BoundedVM(PragueVM):
    """The rules of Prague, in runs that `bounded` limits."""

    _state_class = _BoundedState


MNEMONIC: Final = "test test test test test test test test test test test junk"
"""The phrase that development chains share (anvil, hardhat): its keys are public, and worth nothing elsewhere."""

FUNDS_WEI: Final = 1_000_000 * 10**18
MAX_MINED_BLOCKS: Final = 1_000
"""Empty blocks that one request may mine."""


class MinedBlocks:
    """What is known of the blocks up to `head`, as JSON. Heights are block numbers."""

    def __init__(self, head: int) -> None:
        self.head = head
        """Number of the latest block."""
        self._receipts: dict[bytes, dict[str, Any]] = {}
        self._transactions: dict[bytes, dict[str, Any]] = {}
        self._logs: dict[int, list[dict[str, Any]]] = {}

    def height(self, tag: object) -> int:
        """The block number behind a tag (`latest`, …) or a number. Raises `RpcError` for a missing block."""
        match tag:
            case "latest" | "pending" | "safe" | "finalized":
                return self.head
            case "earliest":
                return 0
            case int() if 0 <= tag <= self.head:
                return tag
        raise RpcError(RpcCode.SERVER_ERROR, f"block {tag!r} not found; the latest is {self.head}")

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


class Evm(MinedBlocks):
    """The state of the chain. Heights are block numbers; amounts are wei.

    A run that computes for more than `run_seconds` and a query that finds more than `max_logs` raise `RpcError`. The
    chain begins `history` seconds ago. Then each block is a second later than the one before, until `go_live`.
    """

    def __init__(self, *, run_seconds: float, max_logs: int, history: int = 0) -> None:
        super().__init__(head=0)
        self._backend = PyEVMBackend.from_mnemonic(
            MNEMONIC,
            genesis_state_overrides={"balance": FUNDS_WEI},
            num_accounts=10,
            hd_path="m/44'/60'/0'/0",
            genesis_parameters=PyEVMBackend.generate_genesis_params(
                {"gas_limit": GAS_LIMIT, "timestamp": int(time.time()) - history}
            ),
        )
        type(self._backend.chain).vm_configuration = ((0, BoundedVM),)
        self._run_seconds = run_seconds
        self.calls = Calls(self._backend.chain, run_seconds=run_seconds)
        self.max_logs = max_logs
        self._is_live = not history

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

    def mine(self, blocks: int) -> None:
        """Mine empty blocks. Raises `RpcError` for more than `MAX_MINED_BLOCKS`."""
        if blocks > MAX_MINED_BLOCKS:
            raise RpcError(RpcCode.INVALID_PARAMS, f"at most {MAX_MINED_BLOCKS} blocks are mined at once")
        for _ in range(blocks):
            self._set_clock()
            self._mine_block()

    def go_live(self) -> None:
        """From now on, the time of a block is that of the clock."""
        self._is_live = True

    def mine_on_time(self) -> None:
        """Mine an empty block because it is time, unless the chain is ahead of the clock: then it waits for it."""
        if self._is_live and self._backend.chain.get_canonical_head().timestamp < int(time.time()):
            self.mine(1)

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
            raise RpcError(RpcCode.SERVER_ERROR, f"the transaction can't be decoded: {error}") from None
        if transaction.hash in self._receipts:
            raise RpcError(RpcCode.SERVER_ERROR, "already known")
        self._check(transaction, sender)
        self._set_clock()
        try:
            with bounded(self._run_seconds):
                self._backend.send_raw_transaction(raw)
        except ValidationError as error:
            raise RpcError(RpcCode.SERVER_ERROR, str(error)) from None
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
            raise RpcError(RpcCode.SERVER_ERROR, "exceeds block gas limit")
        expected = self.nonce(sender, self.head)
        if transaction.nonce != expected:
            which = "low" if transaction.nonce < expected else "high"
            raise RpcError(
                RpcCode.SERVER_ERROR, f"nonce too {which}: next nonce {expected}, tx nonce {transaction.nonce}"
            )
        price = getattr(transaction, "max_fee_per_gas", None) or transaction.gas_price
        wanted, funds = transaction.gas * price + transaction.value, self.balance(sender, self.head)
        if wanted > funds:
            raise RpcError(
                RpcCode.SERVER_ERROR, f"insufficient funds for gas * price + value: have {funds} want {wanted}"
            )

    def _remember(self, hash_: bytes, height: int) -> None:
        receipt = to_json(self._backend.get_transaction_receipt(hash_))
        receipt["to"] = None if receipt["to"] == "0x" else receipt["to"]
        receipt["logsBloom"] = f"0x{int(self._backend.chain.get_canonical_head().bloom):0512x}"
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

    def _set_clock(self) -> None:
        """Set the time of the next block: now, but later than the block before. py-evm has set another one."""
        chain = self._backend.chain
        earliest = int(chain.get_canonical_head().timestamp) + 1
        chain.set_header_timestamp(max(int(time.time()), earliest) if self._is_live else earliest)


Call = dict[str, Any]
"""The fields of a call by their JSON-RPC names, parsed: from, to, data (bytes), value, gas (int)."""


class Calls:
    """Runs calls on a chain. Several threads may use it at once, each run in a state of its own."""

    def __init__(self, chain: ChainAPI, *, run_seconds: float) -> None:
        self._chain: Any = chain
        self._run_seconds = run_seconds
        self._answers: dict[tuple[Any, ...], bytes] = {}
        """What the latest calls have returned, as clients often ask the same; by block, second and call, as a contract
        may ask for the time."""

    def call(self, fields: Call, height: int) -> bytes:
        """What a call returns. Raises `RpcError` with the revert data when it fails."""
        block = self._chain.get_canonical_block_header_by_number(height).hash
        asked = (block, int(time.time()), *sorted(fields.items()))
        if known := self._answers.get(asked):
            return known
        with bounded(self._run_seconds):
            computation = self._run(fields, height, gas=_gas_of(fields))
        _raise_if_failed(computation)
        answer = bytes(computation.output)
        if len(answer) + len(fields["data"]) <= 16 << 10:
            self._answers[asked] = answer
            forget_oldest(self._answers, 256)
        return answer

    def estimate(self, fields: Call, height: int) -> int:
        """Gas limit with which a transaction goes through; raises as `call` does.

        What a run with all gas used; if it calls others, or that is not enough, with the 64th part that a call inside
        keeps back (EIP-150) and the 2,300 gas that a transfer passes on for free; else a search from there, which ends
        within a 64th as geth's does. Calls inside calls keep back a 64th more each, so it looks near first.
        """
        with bounded(self._run_seconds):
            return self._search_gas(fields, height, limit=_gas_of(fields))

    def _search_gas(self, fields: Call, height: int, *, limit: int) -> int:
        computation = self._run(fields, height, gas=limit)
        _raise_if_failed(computation)
        used = limit - int(computation.get_gas_remaining())
        low, with_kept = used - 1, (used + 2_300) * 64 // 63
        for attempt in (with_kept,) if computation.children else (used, with_kept):
            if attempt >= limit:
                return limit
            if self._suffices(fields, height, gas=attempt):
                return attempt
            low = attempt
        high, step = limit, low // 63
        while low + step < limit:
            if self._suffices(fields, height, gas=low + step):
                high = low + step
                break
            low, step = low + step, 2 * step
        while (high - low) * 64 > high:
            attempt = (low + high) // 2
            if self._suffices(fields, height, gas=attempt):
                high = attempt
            else:
                low = attempt
        return high

    def _suffices(self, fields: Call, height: int, *, gas: int) -> bool:
        try:
            return not self._run(fields, height, gas=gas).is_error
        except RpcError:
            return False

    def _run(self, fields: Call, height: int, *, gas: int) -> ComputationAPI:
        """Execute a call in the block after `height`, at no price, and forget what it changed."""
        chain = self._chain
        header: BlockHeaderAPI = chain.get_canonical_block_header_by_number(height)
        sender = fields.get("from") or bytes(20)
        with chain.get_vm(header).in_costless_state() as state:
            unsigned = chain.create_unsigned_transaction(
                nonce=state.get_nonce(sender),
                gas_price=0,
                gas=gas,
                to=fields.get("to") or b"",
                value=fields.get("value") or 0,
                data=fields.get("data") or b"",
            )
            try:
                computation: ComputationAPI = state.costless_execute_transaction(
                    SpoofTransaction(unsigned, from_=sender)
                )
            except ValidationError as error:
                raise RpcError(RpcCode.SERVER_ERROR, str(error)) from None
        return computation


def parse_call(call: dict[str, Any]) -> Call:
    """The fields of a call, parsed. Raises `RpcError`."""
    fields: Call = {"data": parse_data(call.get("input") or call.get("data") or "0x")}
    for name in ("from", "to"):
        if call.get(name) not in (None, "0x"):
            fields[name] = parse_data(call[name], length=20)
    for name in ("gas", "value"):
        if call.get(name) is not None:
            fields[name] = parse_quantity(call[name])
    return fields


def _gas_of(fields: Call) -> int:
    """The gas of a call: what it asks for, within what a block has."""
    return min(int(fields.get("gas") or GAS_LIMIT), GAS_LIMIT)


def _raise_if_failed(computation: ComputationAPI) -> None:
    if not computation.is_error:
        return
    if isinstance(computation.error, Revert):
        raise RpcError(REVERTED, "execution reverted", data="0x" + bytes(computation.output).hex())
    raise RpcError(RpcCode.SERVER_ERROR, f"{type(computation.error).__name__}: {computation.error}")


UNKNOWN_ACCOUNT: Final = "No Signer available"
"""Anvil's words."""


class UnlockedAccounts:
    """Signs messages and transactions. All methods raise `RpcError`, `INVALID_PARAMS` for an account of another."""

    def __init__(self, evm: Evm) -> None:
        self._evm = evm
        self._keys = {address_bytes(Account(key).address): key for key in evm.funded_keys}

    @property
    def addresses(self) -> list[bytes]:
        """In the order in which they were derived."""
        return list(self._keys)

    def sign(self, address: object, text: object) -> bytes:
        """The signature of a personal message (65 bytes, v = 27 or 28)."""
        key = self._key(address)
        return bytes(EthAccount.sign_message(encode_defunct(parse_data(text)), key).signature)

    def send(self, call: dict[str, Any]) -> bytes:
        """Sign a transaction, mine it, and return its hash.

        What it leaves out is filled in: the nonce, the fees, and the gas by an estimate.
        """
        fields = parse_call(call)
        key = self._key(call.get("from"))
        transaction: dict[str, Any] = {
            "chainId": self._evm.chain_id,
            "nonce": self._evm.nonce(fields["from"], self._evm.head),
            "to": fields.get("to", b""),
            "value": fields.get("value", 0),
            "data": fields["data"],
        }
        if call.get("nonce") is not None:
            transaction["nonce"] = parse_quantity(call["nonce"])
        transaction |= self._fees(call)
        transaction["gas"] = fields["gas"] if "gas" in fields else self._evm.calls.estimate(fields, self._evm.head)
        return self._evm.send(Account(key).sign_transaction(transaction).raw)

    def _fees(self, call: dict[str, Any]) -> dict[str, int]:
        """The fees of a transaction as its sender gave them, or such that it is mined."""
        if call.get("gasPrice") is not None:
            return {"gasPrice": parse_quantity(call["gasPrice"])}
        tip = parse_quantity(call.get("maxPriorityFeePerGas") or 0)
        most = parse_quantity(call.get("maxFeePerGas") or 2 * self._evm.base_fee + tip)
        return {"maxFeePerGas": most, "maxPriorityFeePerGas": tip}

    def _key(self, address: object) -> bytes:
        key = self._keys.get(parse_data(address, length=20))
        if key is None:
            raise RpcError(RpcCode.INVALID_PARAMS, UNKNOWN_ACCOUNT)
        return key


TAGS = frozenset({"latest", "pending", "safe", "finalized", "earliest"})

MAX_FILTERS: Final = 1_000
"""The most filters that are kept; a new one replaces the one that was used least recently."""


class Methods:
    """An `Evm` behind JSON-RPC method names."""

    def __init__(self, evm: Evm) -> None:
        self._evm = evm
        accounts, filters = UnlockedAccounts(evm), NodeFilters(evm, self._logs, self._bound)
        tip = 1  # wei a gas
        self._table: dict[str, Callable[..., Any]] = {
            "eth_accounts": lambda: accounts.addresses,
            "eth_coinbase": lambda: accounts.addresses[0],
            "eth_sign": accounts.sign,
            "personal_sign": lambda text, address, _password=None: accounts.sign(address, text),
            "eth_sendTransaction": accounts.send,
            "eth_newFilter": filters.of_logs,
            "eth_newBlockFilter": lambda: filters.add(None),
            "eth_getFilterChanges": filters.changes,
            "eth_getFilterLogs": filters.everything,
            "eth_uninstallFilter": filters.remove,
            "web3_clientVersion": lambda: "aira-embedded/py-evm",
            "web3_sha3": lambda data: keccak256(parse_data(data)),
            "net_version": lambda: str(evm.chain_id),
            "net_listening": lambda: True,
            "net_peerCount": lambda: 0,
            "eth_syncing": lambda: False,
            "eth_chainId": lambda: evm.chain_id,
            "eth_blockNumber": lambda: evm.head,
            "eth_gasPrice": lambda: evm.base_fee + tip,
            "eth_maxPriorityFeePerGas": lambda: tip,
            "eth_getBalance": self._state(evm.balance),
            "eth_getTransactionCount": self._state(evm.nonce),
            "eth_getCode": self._state(evm.code),
            "eth_getStorageAt": self._storage,
            "eth_getBlockByNumber": self._block_by_number,
            "eth_getBlockByHash": self._block_by_hash,
            "eth_getTransactionByHash": lambda hash_: evm.transaction(parse_data(hash_, length=32)),
            "eth_getTransactionReceipt": lambda hash_: evm.receipt(parse_data(hash_, length=32)),
            "eth_getLogs": self._logs,
            "eth_call": lambda call, block="latest": evm.calls.call(parse_call(call), self._height(block)),
            "eth_estimateGas": lambda call, block="latest": evm.calls.estimate(parse_call(call), self._height(block)),
            "eth_sendRawTransaction": lambda raw: evm.send(parse_data(raw)),
            "evm_mine": self._mine,
            "evm_snapshot": lambda: evm.head,
            "evm_revert": self._revert,
        }

    def answer(self, method: str, params: Sequence[Any]) -> Any:
        """The result of a method, as JSON. Raises `RpcError` and nothing else, for any parameters."""
        function = self._table.get(method)
        if function is None:
            raise RpcError(METHOD_NOT_FOUND, f"the method {method} does not exist or is not available")
        try:
            return to_json(function(*params))
        except RpcError:
            raise
        except RecursionError:
            raise RpcError(RpcCode.SERVER_ERROR, "contracts call each other too deep for this node") from None
        except (TypeError, ValueError, AttributeError, KeyError) as error:
            raise RpcError(RpcCode.INVALID_PARAMS, f"the parameters of {method} can't be: {error}") from error
        except Exception as error:
            raise RpcError(RpcCode.INTERNAL_ERROR, f"{method} failed: {type(error).__name__}: {error}") from error

    def _height(self, block: object) -> int:
        return self._evm.height(block if block in TAGS else parse_quantity(block))

    def _state(self, read: Callable[[bytes, int], Any]) -> Callable[..., Any]:
        def method(address: object, block: object = "latest") -> Any:
            return read(parse_data(address, length=20), self._height(block))

        return method

    def _storage(self, address: object, slot: object, block: object = "latest") -> bytes:
        return self._evm.storage(parse_data(address, length=20), parse_quantity(slot), self._height(block))

    def _block_by_number(self, block: object, full: object = False) -> dict[str, Any] | None:
        number = parse_quantity(block) if block not in TAGS else self._height(block)
        return self._evm.block(number, transactions="objects" if full else "hashes")

    def _block_by_hash(self, hash_: object, full: object = False) -> dict[str, Any] | None:
        return self._evm.block(parse_data(hash_, length=32), transactions="objects" if full else "hashes")

    def _mine(self, blocks: object = 1) -> str:
        self._evm.mine(parse_quantity(blocks))
        return "0x0"

    def _revert(self, snapshot: object) -> bool:
        self._evm.rewind(parse_quantity(snapshot))
        return True

    def _logs(self, query: dict[str, Any]) -> list[dict[str, Any]]:
        if "blockHash" in query:
            block = self._block_by_hash(query["blockHash"])
            if block is None:
                raise RpcError(RpcCode.INVALID_PARAMS, "unknown block")
            first = last = int(block["number"], 16)
        else:
            first = self._bound(query.get("fromBlock"))
            last = self._bound(query.get("toBlock"))
        wanted = LogFilter(query)
        found = list(
            islice((log for log in self._evm.logs(first, last) if wanted.accepts(log)), self._evm.max_logs + 1)
        )
        if len(found) > self._evm.max_logs:
            raise RpcError(RpcCode.LIMIT_EXCEEDED, f"query returned more than {self._evm.max_logs} results")
        return found

    def _bound(self, block: object) -> int:
        """A bound of a range of blocks, which may be past the head, unlike the block of a call."""
        return self._evm.height(block or "latest") if block is None or block in TAGS else parse_quantity(block)


@dataclass(slots=True)
class _Filter:
    """The query of a filter (None for new blocks), and the next block that it has not returned."""

    query: dict[str, Any] | None
    next_block: int


class NodeFilters:
    """The filters of one node (`eth_newFilter`, …): each returns what is new since the last request.

    `logs` answers a query as `eth_getLogs` does, and `bound` reads a bound of its range. All methods raise `RpcError`.
    """

    def __init__(
        self, evm: Evm, logs: Callable[[dict[str, Any]], list[dict[str, Any]]], bound: Callable[[object], int]
    ) -> None:
        self._evm = evm
        self._logs = logs
        self._bound = bound
        self._filters: OrderedDict[str, _Filter] = OrderedDict()
        self._made = 0

    def of_logs(self, query: object) -> str:
        """Add a filter for the logs that a query accepts; its id."""
        LogFilter(query)  # raises for an invalid query
        assert isinstance(query, dict)
        return self.add(query)

    def add(self, query: dict[str, Any] | None) -> str:
        """Add a filter for the logs of a query, or for the hashes of new blocks (None); its id."""
        self._made += 1
        name = hex(self._made)
        self._filters[name] = _Filter(query, self._evm.head + 1)
        if len(self._filters) > MAX_FILTERS:
            self._filters.popitem(last=False)
        return name

    def changes(self, name: object) -> list[Any]:
        """What is new since the last request. The rest follows with the next one if it is much."""
        found = self._find(name)
        # The chain may have been reverted in the meantime.
        first = min(found.next_block, self._evm.head + 1)
        found.next_block = self._evm.head + 1
        if found.query is None:
            found.next_block = min(found.next_block, first + self._evm.max_logs)
            return [self._hash(number) for number in range(first, found.next_block)]
        if isinstance(found.query.get("fromBlock"), str) and found.query["fromBlock"].startswith("0x"):
            first = max(first, parse_quantity(found.query["fromBlock"]))
        wanted, last = LogFilter(found.query), self._bound(found.query.get("toBlock"))
        logs: list[dict[str, Any]] = []
        for log in self._evm.logs(first, last):
            if wanted.accepts(log):
                if len(logs) >= self._evm.max_logs and log["blockNumber"] != logs[-1]["blockNumber"]:
                    found.next_block = int(log["blockNumber"], 16)
                    break
                logs.append(log)
        return logs

    def everything(self, name: object) -> list[dict[str, Any]]:
        """All logs that a filter's query accepts."""
        query = self._find(name).query
        if query is None:
            raise RpcError(RpcCode.INVALID_PARAMS, "this filter is of blocks, not of logs")
        return self._logs(query)

    def remove(self, name: object) -> bool:
        """Remove a filter; False if there was none."""
        return self._filters.pop(str(name), None) is not None

    def _find(self, name: object) -> _Filter:
        found = self._filters.get(str(name))
        if found is None:
            raise RpcError(RpcCode.SERVER_ERROR, "filter not found")
        self._filters.move_to_end(str(name))
        return found

    def _hash(self, number: int) -> str:
        block = self._evm.block(number, transactions="hashes")
        assert block is not None
        return str(block["hash"])
