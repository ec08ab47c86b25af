"""A chain of blocks over the model of the contracts, with the methods that the embedded EVM has.

It has no gas of its own: each transaction takes what `gas_of` says, whatever the contracts do.
"""

from __future__ import annotations

import time
from contextlib import suppress
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import rlp  # type: ignore[import-untyped]

from mesh.chain._node import RUN_NUMBER
from mesh.chain.answers import NO_TRANSACTIONS, REVERTED
from mesh.dev._evm import FUNDS_WEI, MinedBlocks
from mesh.dev._rpc import RpcCode, RpcError, parse_data
from schemas import Signer, keccak256
from schemas.address import address_bytes
from tests.simulation.model_abi import ModelRevert, artifact
from tests.simulation.model_contracts import ModelBlockingToken, ModelJury, ModelNames, ModelResolver, ModelToken
from tests.simulation.model_factory import ModelFactory
from tests.simulation.model_state import ModelRun, ModelState
from tests.simulation.model_transactions import ModelTransaction, read_transaction
from tests.support.multicall import decode_calls, encode_answers

if TYPE_CHECKING:
    from collections.abc import Sequence

    from mesh.dev._evm import Call

    ModelLog = tuple[bytes, list[bytes], bytes]

CHAIN_ID: Final = 131277322940537
"""That of the embedded EVM."""
GAS_LIMIT: Final = 30_000_000
BASE_FEE: Final = 10**9
"""wei a gas in the first block."""
CREATED: Final = (ModelToken, ModelBlockingToken, ModelNames, ModelResolver, ModelFactory, ModelJury)


class _Applied(NamedTuple):
    """A transaction in a block, and what it did."""

    one: ModelTransaction
    logs: tuple[ModelLog, ...]
    status: int
    created: bytes
    """The address of the contract that it made, if it made one."""
    gas: int
    price: int


class ModelChain(MinedBlocks):
    """The chain. Heights are block numbers; amounts are wei."""

    def __init__(self, funded_keys: tuple[bytes, ...], *, max_logs: int = 100_000) -> None:
        super().__init__(head=-1)
        self.funded_keys = funded_keys
        self.chain_id = CHAIN_ID
        self.max_logs = max_logs
        self.base_fee = BASE_FEE
        self.calls = self
        self._state = ModelState()
        self._blocks: list[dict[str, Any]] = []
        self._base_fees: list[int] = []
        """Of the block after each one."""
        self._by_hash: dict[str, int] = {}
        accounts = [_address_of(key) for key in funded_keys]
        self._state.apply(0, {(account, "wei"): FUNDS_WEI for account in accounts})
        self._add_block()

    def balance(self, address: bytes, height: int) -> int:
        """Wei of an account."""
        return int(self._state.get((address, "wei"), 0, height))

    def nonce(self, address: bytes, height: int) -> int:
        """Number of transactions that an account has sent."""
        return int(self._state.get((address, "sent"), 0, height))

    def code(self, address: bytes, height: int) -> bytes:
        """A contract's code, empty for an account."""
        return self._run(height).code(address)

    def storage(self, address: bytes, slot: int, height: int) -> bytes:
        """A storage slot: the model has none."""
        raise RpcError(RpcCode.SERVER_ERROR, "storage is not modelled")

    def block(self, identifier: int | bytes, *, transactions: str) -> dict[str, Any] | None:
        """A block by number or hash, None if there is none; its `transactions` as `"hashes"` or as `"objects"`."""
        number = self._by_hash.get("0x" + identifier.hex()) if isinstance(identifier, bytes) else identifier
        if number is None or number > self.head:
            return None
        block = self._blocks[number]
        if transactions == "objects":
            mined = [self._transactions[bytes.fromhex(hash_[2:])] for hash_ in block["transactions"]]
            return block | {"transactions": mined}
        return block

    def call(self, fields: Call, height: int) -> bytes:
        """What a call returns. Raises `RpcError` with the revert data when it fails."""
        run = self._run(height)
        sender, data, value = fields.get("from") or bytes(20), fields.get("data") or b"", fields.get("value") or 0
        try:
            if fields.get("to") is None and data == RUN_NUMBER:
                return (height + 1).to_bytes(32)
            if fields.get("to") is None and (calls := decode_calls(data)) is not None:
                return encode_answers([self._answer(run, sender, parse_data(to, length=20), one) for to, one in calls])
            if fields.get("to") is None:
                return self._create(run, sender, data)
            return run.call(sender, fields["to"], data, value=value)
        except ModelRevert as error:
            raise RpcError(REVERTED, "execution reverted", data="0x" + error.data.hex()) from None

    def _answer(self, run: ModelRun, sender: bytes, to: bytes, data: bytes) -> bytes | None:
        """What one call of many returns; None if it fails."""
        try:
            return run.call(sender, to, data, value=0)
        except ModelRevert:
            return None

    def estimate(self, fields: Call, height: int) -> int:
        """Gas limit with which a transaction goes through; raises as `call` does."""
        self.call(fields, height)
        return gas_of(fields.get("to") or b"", fields.get("data") or b"") * 5 // 4

    def mine(self, blocks: int) -> None:
        """Mine empty blocks."""
        for _ in range(blocks):
            self._add_block()

    def rewind(self, height: int) -> None:
        """Remove all blocks after one."""
        self._state.rewind(height)
        for block in self._blocks[height + 1 :]:
            del self._by_hash[block["hash"]]
            self._logs.pop(int(block["number"], 16), None)
            for hash_ in block["transactions"]:
                raw = bytes.fromhex(hash_[2:])
                del self._receipts[raw], self._transactions[raw]
        del self._blocks[height + 1 :], self._base_fees[height + 1 :]
        self.head, self.base_fee = height, self._base_fees[-1]

    def send(self, raw: bytes) -> bytes:
        """Apply a signed transaction and mine its block; its hash. Raises `RpcError` for one that no block can hold."""
        one = read_transaction(raw)
        self._add_block([self._apply(one, follows=False)])
        return one.hash

    def mine_together(self, raws: Sequence[bytes]) -> set[bytes]:
        """Mine one block of signed transactions, without those that it can't hold; the hashes of the others."""
        applied: list[_Applied] = []
        for raw in raws:
            with suppress(RpcError):
                applied.append(self._apply(read_transaction(raw), follows=bool(applied)))
        self._add_block(applied)
        return {each.one.hash for each in applied}

    def _apply(self, one: ModelTransaction, *, follows: bool) -> _Applied:
        """Apply a transaction in the next block. Raises `RpcError`."""
        self._check(one, self.head + follows)
        run = ModelRun(self._state, self.head, self.chain_id, follows=follows)
        status, created, gas = 1, b"", gas_of(one.to, one.data)
        try:
            if gas > one.gas:
                raise ModelRevert  # out of gas
            if one.to:
                run.call(one.sender, one.to, one.data, value=one.value)
            else:
                created = self._create(run, one.sender, one.data)
        except ModelRevert:
            status, gas = 0, min(gas, one.gas)
            run = ModelRun(self._state, self.head, self.chain_id, follows=follows)
        price = min(one.price, self.base_fee + one.priority)
        run.set(one.sender, "sent", one.nonce + 1)
        run.set(one.sender, "wei", run.get(one.sender, "wei") - gas * price - (one.value if status else 0))
        if status and one.value:
            run.set(one.to, "wei", run.get(one.to, "wei") + one.value)
        self._state.apply(self.head + 1, run.writes)
        return _Applied(one, tuple(run.logs) if status else (), status, created, gas, price)

    def read(self, raw: bytes) -> ModelTransaction:
        """A signed transaction. Raises `RpcError`."""
        return read_transaction(raw)

    def _run(self, height: int) -> ModelRun:
        return ModelRun(self._state, height, self.chain_id)

    def _check(self, one: ModelTransaction, height: int) -> None:
        if one.hash in self._receipts:
            raise RpcError(RpcCode.SERVER_ERROR, "already known")
        if one.gas > GAS_LIMIT:
            raise RpcError(RpcCode.SERVER_ERROR, "exceeds block gas limit")
        expected = self.nonce(one.sender, height)
        if one.nonce != expected:
            which = "low" if one.nonce < expected else "high"
            raise RpcError(RpcCode.SERVER_ERROR, f"nonce too {which}: next nonce {expected}, tx nonce {one.nonce}")
        funds, wanted = self.balance(one.sender, height), one.gas * one.price + one.value
        if wanted > funds:
            raise RpcError(
                RpcCode.SERVER_ERROR, f"insufficient funds for gas * price + value: have {funds} want {wanted}"
            )
        if one.price < self.base_fee:
            raise RpcError(RpcCode.SERVER_ERROR, "max fee per gas less than block base fee")

    def _create(self, run: ModelRun, sender: bytes, data: bytes) -> bytes:
        nonce = int(run.get(sender, "sent"))
        address = keccak256(rlp.encode([sender, nonce]))[12:]
        for kind in CREATED:
            creation = bytes.fromhex(artifact(kind.NAME)["bytecode"][2:])
            if data.startswith(creation):
                kind(run, address, sender).construct(data[len(creation) :])
                run.set(address, "contract", (kind, bytes.fromhex(artifact(kind.NAME)["deployedBytecode"][2:])))
                return address
        raise ModelRevert

    def _add_block(self, applied: Sequence[_Applied] = ()) -> None:
        hashes, gas = [each.one.hash for each in applied], sum(each.gas for each in applied)
        logs = [log for each in applied for log in each.logs]
        self.head += 1
        parent = self._blocks[-1] if self._blocks else None
        when = int(time.time())
        if parent is not None:
            when = max(when, int(parent["timestamp"], 16))
        parent_hash = "0x" + bytes(32).hex() if parent is None else str(parent["hash"])
        seed = f"{parent_hash} {self.head} {when} {b''.join(hashes).hex()}"
        hash_ = "0x" + keccak256(seed.encode()).hex()
        self._blocks.append(
            {
                "number": hex(self.head),
                "hash": hash_,
                "parentHash": parent_hash,
                "timestamp": hex(when),
                "baseFeePerGas": hex(self.base_fee),
                "gasLimit": hex(GAS_LIMIT),
                "gasUsed": hex(gas),
                "miner": "0x" + bytes(20).hex(),
                "logsBloom": f"0x{bloom_of(logs):0512x}",
                "transactionsRoot": "0x" + (keccak256(b"".join(hashes)) if hashes else NO_TRANSACTIONS).hex(),
                "transactions": ["0x" + hash_.hex() for hash_ in hashes],
            }
        )
        self._by_hash[hash_] = self.head
        target = GAS_LIMIT // 2
        change = self.base_fee * abs(gas - target) // target // 8
        self.base_fee += max(change, 1) if gas > target else -change
        self._base_fees.append(self.base_fee)
        for index, each in enumerate(applied):
            self._remember(each, index)

    def _remember(self, applied: _Applied, index: int) -> None:
        one, block, earlier = applied.one, self._blocks[-1], self._logs.get(self.head, [])
        hash_ = "0x" + one.hash.hex()
        where = {"blockNumber": block["number"], "blockHash": block["hash"], "transactionIndex": hex(index)}
        to = "0x" + one.to.hex() if one.to else None
        mined = {"transactionHash": hash_, "removed": False} | where
        logs = [
            {
                "address": "0x" + address.hex(),
                "topics": ["0x" + topic.hex() for topic in topics],
                "data": "0x" + data.hex(),
                "logIndex": hex(index),
            }
            | mined
            for index, (address, topics, data) in enumerate(applied.logs, len(earlier))
        ]
        sender = "0x" + one.sender.hex()
        self._receipts[one.hash] = where | {
            "transactionHash": hash_,
            "from": sender,
            "to": to,
            "contractAddress": "0x" + applied.created.hex() if applied.created else None,
            "status": hex(applied.status),
            "gasUsed": hex(applied.gas),
            "cumulativeGasUsed": hex(applied.gas),
            "effectiveGasPrice": hex(applied.price),
            "type": "0x2",
            "logs": logs,
            "logsBloom": block["logsBloom"],
        }
        self._transactions[one.hash] = where | {
            "hash": hash_,
            "from": sender,
            "to": to,
            "nonce": hex(one.nonce),
            "input": "0x" + one.data.hex(),
            "value": hex(one.value),
            "gas": hex(one.gas),
            "maxFeePerGas": hex(one.price),
            "maxPriorityFeePerGas": hex(one.priority),
            "gasPrice": hex(applied.price),
            "type": "0x2",
            "chainId": hex(self.chain_id),
        }
        if logs:
            self._logs[self.head] = earlier + logs


def bloom_of(logs: Sequence[ModelLog]) -> int:
    """The Bloom filter of logs: three bits for each address and topic."""
    bloom = 0
    for address, topics, _ in logs:
        for digest in map(keccak256, (address, *topics)):
            for at in (0, 2, 4):
                bloom |= 1 << int.from_bytes(digest[at : at + 2], "big") % 2048
    return bloom


def gas_of(to: bytes, data: bytes) -> int:
    """What a transaction takes, about."""
    if not data:
        return 21_000
    return 250_000 if to else 3_000_000


def _address_of(key: bytes) -> bytes:
    return address_bytes(Signer(key).address)
