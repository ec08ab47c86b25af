"""The simulated chain: the contracts on the embedded EVM or their model, with a pool, blocks and reorganisations.

Each process reaches it through a node of its own, which may be slow, silent or wrong.
"""

from __future__ import annotations

import asyncio
from contextlib import suppress
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Final, cast

import msgspec

from mesh.chain.answers import ANSWERS, Count, decode_answer
from mesh.chain.following import decode_log
from mesh.dev._evm import GAS_LIMIT, Call, Calls, Evm, Methods, parse_call
from mesh.dev._rpc import RpcCode, RpcError, parse_data
from tests.simulation.chance import FaultDraw
from tests.simulation.memo import Answer
from tests.simulation.model import ModelChain
from tests.simulation.model_transactions import read_transaction
from tests.simulation.threads import scheduler

if TYPE_CHECKING:
    import random
    from collections.abc import Callable

    from mesh.chain import ChainEvent
    from tests.simulation.model_transactions import ModelTransaction

LATENCY: Final = (0.001, 0.03)
BUMP_PERCENT: Final = 10
"""By how much a transaction must pay more to take another's place."""
SEND: Final = "eth_sendRawTransaction"


@dataclass
class NodeFaults:
    """How probable each fault of an answer is."""

    unreachable: float = 0.0
    silent: float = 0.0
    late: float = 0.0
    spoilt: float = 0.0
    lost_after_sending: float = 0.0
    draw: FaultDraw = field(default_factory=FaultDraw)

    def stop(self) -> None:
        """Answer properly from now on."""
        self.unreachable = self.silent = self.late = self.spoilt = self.lost_after_sending = 0.0


@dataclass
class MiningFaults:
    """How probable it is that a block leaves a transaction out, or that the pool forgets it; how much gas costs."""

    leave_out: float = 0.0
    forget: float = 0.0
    price_factor: float = 1.0
    draw: FaultDraw = field(default_factory=FaultDraw)


@dataclass(frozen=True)
class PooledTransaction:
    """A transaction that waits to be mined."""

    raw: bytes
    hash: bytes
    sender: bytes
    nonce: int
    price: int


class EvmCalls(Calls):
    """Calls on the EVM, with estimates from one run: the embedded node takes several to find the least."""

    def estimate(self, fields: Call, height: int) -> int:
        """Enough gas for a transaction; raises as `call` does."""
        computation = self._run(fields, height, gas=GAS_LIMIT)
        if computation.is_error:
            self.call(fields, height)  # raises
        return (GAS_LIMIT - int(computation.get_gas_remaining())) * 5 // 4


class EvmChain(Evm):
    """The real contracts on the embedded EVM."""

    def __init__(self) -> None:
        super().__init__(run_seconds=60.0, max_logs=100_000)
        self.calls = EvmCalls(self._backend.chain, run_seconds=60.0)

    def read(self, raw: bytes) -> ModelTransaction:
        """A signed transaction. Raises `RpcError`."""
        return read_transaction(raw)


class SimulatedChain:
    """The chain that all nodes show. `began` is the height at which the history began."""

    def __init__(self, evm: EvmChain | ModelChain) -> None:
        self.evm = evm
        self.methods = Methods(cast("Evm", evm))
        self.instant = True
        """Mine each transaction at once, as while the contracts are deployed."""
        self.pool: dict[tuple[bytes, int], PooledTransaction] = {}
        self.mined: dict[int, list[PooledTransaction]] = {}
        """By block."""
        self.most_in_block = 1
        self.faults = MiningFaults()
        self.began = 0
        self.reorganisations = 0
        self.deepest = 0
        self.on_block: Callable[[], None] = lambda: None
        self._cache: dict[bytes, Answer] = {}
        self._events: dict[int, tuple[str, list[ChainEvent | None]]] = {}
        """By block: its hash, and what was logged in it."""

    def begin(self) -> None:
        """From now on blocks are mined by time."""
        self.instant = False
        self.began = self.evm.head
        self._cache.clear()

    def answer(self, method: str, params: Any) -> Any:
        """The result of a JSON-RPC method, which must not be changed. Raises `RpcError`."""
        return self.response(method, params)["result"]

    def response(self, method: str, params: Any) -> Answer:
        """The same as the response of a node."""
        if method == SEND and not self.instant:
            return Answer(result="0x" + self.submit(parse_data(params[0])).hex())
        if method == SEND:
            self._cache.clear()
            return Answer(result=self.methods.answer(method, params))
        key = method.encode() + msgspec.json.encode(params)
        if key not in self._cache:
            self._cache[key] = Answer(result=self._answer(method, params))
        return self._cache[key]

    def _answer(self, method: str, params: Any) -> Any:
        if method == "eth_estimateGas":
            return hex(self.evm.calls.estimate(parse_call(params[0]), self.evm.head))
        if method == "eth_getTransactionCount" and params[1:] == ["pending"]:
            return hex(self._next_nonce(parse_data(params[0], length=20)))
        if method in ("eth_gasPrice", "eth_maxPriorityFeePerGas"):
            return hex(round(int(self.methods.answer(method, params), 16) * self.faults.price_factor))
        if method == "eth_getTransactionByHash":
            waiting = next((one for one in self.pool.values() if one.hash == parse_data(params[0])), None)
            if waiting is not None:
                nonce, sender = hex(waiting.nonce), "0x" + waiting.sender.hex()
                return {"hash": params[0], "blockHash": None, "blockNumber": None, "from": sender, "nonce": nonce}
        return self.methods.answer(method, params)

    def events(self, first: int, last: int) -> list[ChainEvent | None]:
        """What the contracts logged in some blocks; None for what is no event of theirs."""
        found: list[ChainEvent | None] = []
        for number in range(first, last + 1):
            block = self.evm.block(number, transactions="hashes")
            known = self._events.get(number)
            if block is not None and (known is None or known[0] != block["hash"]):
                response = {"result": list(self.evm.logs(number, number))}
                logs = decode_answer("eth_getLogs", response, ANSWERS["eth_getLogs"])
                known = self._events[number] = (block["hash"], [decode_log(log) for log in logs])
            found += [] if known is None else known[1]
        return found

    def submit(self, raw: bytes) -> bytes:
        """Take a signed transaction into the pool; its hash. Raises `RpcError`."""
        one = self.evm.read(raw)
        sender, nonce, price, hash_ = one.sender, one.nonce, one.price, one.hash
        expected = self.evm.nonce(sender, self.evm.head)
        if nonce < expected:
            raise RpcError(RpcCode.SERVER_ERROR, f"nonce too low: next nonce {expected}, tx nonce {nonce}")
        before = self.pool.get((sender, nonce))
        if before is not None and before.hash == hash_:
            raise RpcError(RpcCode.SERVER_ERROR, "already known")
        if before is not None and price * 100 < before.price * (100 + BUMP_PERCENT):
            raise RpcError(RpcCode.SERVER_ERROR, "replacement transaction underpriced")
        funds, wanted = self.evm.balance(sender, self.evm.head), one.gas * price + one.value
        if wanted > funds:
            raise RpcError(
                RpcCode.SERVER_ERROR, f"insufficient funds for gas * price + value: have {funds} want {wanted}"
            )
        self.pool[sender, nonce] = PooledTransaction(raw, hash_, sender, nonce, price)
        self._cache.clear()
        return hash_

    def mine(self) -> None:
        """Mine what the pool has, with `most_in_block` transactions in a block; an empty block if there is none."""
        self._cache.clear()
        if not self._mine_pool():
            self.evm.mine(1)
        self.on_block()

    def reorganise(self, depth: int, *, forget: float) -> None:
        """Replace the last blocks; their transactions go back to the pool, in which some are forgotten."""
        self._cache.clear()
        depth = min(depth, self.evm.head - self.began)
        if depth < 1:
            return
        head = self.evm.head
        self.evm.rewind(head - depth)
        for transaction in [
            one
            for number in sorted(number for number in self.mined if number > head - depth)
            for one in self.mined.pop(number)
        ]:
            if not self.faults.draw("transaction-forgotten", forget):
                self.pool.setdefault((transaction.sender, transaction.nonce), transaction)
        self.reorganisations += 1
        self.deepest = max(self.deepest, depth)
        self._mine_pool()
        while self.evm.head <= head:
            self.evm.mine(1)
        self.on_block()

    def _mine_pool(self) -> bool:
        chance, chosen, expected = scheduler().random, list[PooledTransaction](), dict[bytes, int]()
        waiting = sorted(self.pool.values(), key=lambda one: (one.sender, one.nonce))
        chance.shuffle(waiting)
        waiting.sort(key=lambda one: one.nonce)  # stable: of each sender in order
        head = self.evm.head
        for one in waiting:
            if self.faults.draw("transaction-forgotten", self.faults.forget):
                del self.pool[one.sender, one.nonce]
                continue
            if self.faults.draw("transaction-left-out", self.faults.leave_out):
                continue
            if one.price < self.evm.base_fee * self.faults.price_factor:
                continue
            nonce = expected.setdefault(one.sender, self.evm.nonce(one.sender, self.evm.head))
            if one.nonce != nonce:
                if one.nonce < nonce:
                    del self.pool[one.sender, one.nonce]
                continue
            del self.pool[one.sender, one.nonce]
            expected[one.sender] += 1
            chosen.append(one)
            if len(chosen) == self.most_in_block:
                self._mine_block(chosen)
                chosen, expected = [], {}
        if chosen:
            self._mine_block(chosen)
        return self.evm.head > head

    def _mine_block(self, chosen: list[PooledTransaction]) -> None:
        if self.most_in_block > 1:
            assert isinstance(self.evm, ModelChain), "the embedded EVM has one transaction in a block"
            hashes = self.evm.mine_together([one.raw for one in chosen])
            self.mined[self.evm.head] = [one for one in chosen if one.hash in hashes]
            return
        with suppress(RpcError):
            self.evm.send(chosen[0].raw)
            self.mined[self.evm.head] = chosen

    def _next_nonce(self, sender: bytes) -> int:
        nonce = self.evm.nonce(sender, self.evm.head)
        while (sender, nonce) in self.pool:
            nonce += 1
        return nonce


class SimulatedNode:
    """A node of that chain, as one process reaches it."""

    def __init__(self, chain: SimulatedChain, faults: NodeFaults, number: int = 0) -> None:
        self._number = number
        self._chain = chain
        self._faults = faults

    async def make_request(self, method: Any, params: Any) -> Any:
        """A JSON-RPC response, or one of the faults."""
        faults, draw = self._faults, self._faults.draw
        await asyncio.sleep(scheduler().random.uniform(*LATENCY))
        if draw("node-unreachable", faults.unreachable):
            raise ConnectionRefusedError(111, "Connection refused")
        if draw("node-silent", faults.silent):
            await asyncio.sleep(3600)
        if draw("node-late", faults.late):
            await asyncio.sleep(draw.random.uniform(0.1, 10))
        response: dict[str, Any]
        try:
            response = self._chain.response(method, params)
        except RpcError as error:
            response = {"error": error.as_object()}
        if method == SEND and draw("answer-lost", faults.lost_after_sending):
            raise ConnectionResetError(104, "Connection reset by peer")
        if draw("answer-spoilt", faults.spoilt):
            return spoil(method, msgspec.json.decode(msgspec.json.encode(response)), draw.random)
        return response

    async def is_connected(self, show_traceback: bool = False) -> bool:
        """Whether it answers."""
        return True

    def __str__(self) -> str:
        return f"the simulated node {self._number}"


def spoil(method: str, response: dict[str, Any], chance: random.Random) -> Any:
    """A response in which something is wrong, and can be seen to be: not an empty list in place of events."""
    result = response.get("result")
    others: list[Any] = [None, "", "0x", {}, "0xzz", 7]
    if ANSWERS.get(method) is Count:
        others.append("0x" + "ff" * 32)
    if not isinstance(result, list):
        others.append([])
    if isinstance(result, list) and result and isinstance(result[0], dict):
        result = result[0]
    if isinstance(result, dict) and chance.random() < 0.7:
        del result[chance.choice(sorted(result))]
        return response
    return {"jsonrpc": "2.0", "id": 0, "result": chance.choice(others)}
