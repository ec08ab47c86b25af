"""An imitation of Arbitrum's blocks, on a real EVM: contracts see the numbers of another chain's blocks."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from eth.vm import mnemonics, opcode_values
from eth.vm.opcode import as_opcode

from mesh.dev import EmbeddedChain
from mesh.dev._evm import BoundedVM

if TYPE_CHECKING:
    from eth.abc import ComputationAPI

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
