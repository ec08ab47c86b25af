"""Imitations of rollups on a real EVM: Arbitrum's blocks, whose numbers in contracts are another chain's, and the fee
for data of the OP type."""

from __future__ import annotations

import zlib
from typing import TYPE_CHECKING, Any, Final

from eth.vm import mnemonics, opcode_values
from eth.vm.opcode import as_opcode

from mesh.chain._abi import decode
from mesh.chain._node import FEE_ORACLE
from mesh.dev import EmbeddedChain
from mesh.dev._evm import BoundedVM
from schemas import keccak256

if TYPE_CHECKING:
    from eth.abc import ComputationAPI

    from mesh.chain.rpc import Transport

FIRST: Final = 20_000_000
"""What contracts see in the first block."""


def seen_in(block: int) -> int:
    """The number that contracts see in a block: the same for two to four blocks, and then one more, or four."""
    return FIRST + block // 3 + 3 * (block // 16)


def _number(computation: ComputationAPI) -> None:
    computation.stack_push_int(seen_in(computation.state.block_number))


_opcodes = BoundedVM.get_state_class().computation_class.opcodes


class _Computation(BoundedVM.get_state_class().computation_class):  # type: ignore[misc]
    opcodes = _opcodes | {opcode_values.NUMBER: as_opcode(_number, mnemonics.NUMBER, gas_cost=2)}


class _State(BoundedVM.get_state_class()):  # type: ignore[misc]
    computation_class = _Computation


class _VM(BoundedVM):
    _state_class = _State


class ForeignBlocks(EmbeddedChain):
    """An embedded chain whose contracts count another chain's blocks (`seen_in`)."""

    def _start(self, history: int = 0) -> None:
        super()._start(history)
        assert self._evm is not None
        type(self._evm._backend.chain).vm_configuration = ((0, _VM),)  # a class of this chain alone


L1_BASE_FEE: Final = 8_000_000_000
BASE_FEE_SCALAR: Final = 2_269
"""As on Base in 2024."""
BLOB_BASE_FEE: Final = 1_000_000_000
BLOB_BASE_FEE_SCALAR: Final = 1_055_762


def data_fee(transaction: bytes) -> int:
    """What the oracle says of an unsigned transaction, wei: Fjord's formula, with another compression for FastLZ."""
    size = len(zlib.compress(transaction)) + 68
    estimated = max(100 * 10**6, 836_500 * size - 42_585_600)
    scaled = 16 * BASE_FEE_SCALAR * L1_BASE_FEE + BLOB_BASE_FEE_SCALAR * BLOB_BASE_FEE
    return estimated * scaled // 10**12


class OpStack:
    """The way to a node that answers as op-geth does: receipts with the fee for data, and the oracle that tells it.

    The fields are those of op-geth's `marshalReceipt` since Ecotone. The embedded chain does not charge the fee, so
    compare what programs count with `charged`.
    """

    def __init__(self, node: Transport) -> None:
        self._node = node
        self._fees: dict[str, int] = {}
        self.asked = 0
        """How often the oracle was asked."""

    def charged(self, tx: str) -> int:
        """What a transaction was charged for its data, wei."""
        return self._fees[tx]

    async def make_request(self, method: str, params: Any) -> Any:
        if method == "eth_call" and params[0].get("to") == FEE_ORACLE:
            data = bytes.fromhex(params[0]["data"][2:])
            assert data[:4] == keccak256(b"getL1Fee(bytes)")[:4]
            self.asked += 1
            fee = data_fee(decode(["bytes"], data[4:])[0])
            return {"jsonrpc": "2.0", "id": 0, "result": "0x" + fee.to_bytes(32).hex()}
        response = await self._node.make_request(method, params)
        if method == "eth_sendRawTransaction" and "result" in response:
            self._fees[response["result"]] = data_fee(bytes.fromhex(params[0][2:])[:-68])
        receipt = response.get("result")
        if method != "eth_getTransactionReceipt" or receipt is None:
            return response
        fields = {
            "l1GasPrice": hex(L1_BASE_FEE),
            "l1GasUsed": hex(1_600),
            "l1Fee": hex(self._fees.get(receipt["transactionHash"], 0)),
            "l1BaseFeeScalar": hex(BASE_FEE_SCALAR),
            "l1BlobBaseFee": hex(BLOB_BASE_FEE),
            "l1BlobBaseFeeScalar": hex(BLOB_BASE_FEE_SCALAR),
        }
        return response | {"result": receipt | fields}

    def __str__(self) -> str:
        return "a rollup of the OP type"
