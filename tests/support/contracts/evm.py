"""A deployed chain as bare state: calls without transactions, receipts and blocks, some hundred times as many a second.

What a transaction adds to a call is not here: its sender pays nothing, and gas is not to be measured.
"""

from __future__ import annotations

from functools import cache
from typing import TYPE_CHECKING, Any, Final, NamedTuple

from eth.vm.chain_context import ChainContext
from eth.vm.message import Message
from eth_abi.abi import encode
from eth_typing import Address

from mesh.chain.answers import explain
from schemas import address_bytes, checksum_address, keccak256

if TYPE_CHECKING:
    from tests.support.contracts.chains import Chain

GAS: Final = 8_000_000


class Answer(NamedTuple):
    """What became of a call: the data it returned and the events (emitter, topics), or why it was refused."""

    output: bytes
    logs: list[tuple[str, list[bytes]]]
    refusal: str | None

    @property
    def number(self) -> int:
        """The data as one unsigned word."""
        return int.from_bytes(self.output, "big")


class Evm:
    """The state of a py-evm chain after its latest block; what happens here the chain never learns."""

    def __init__(self, chain: Chain) -> None:
        backend = chain.web3.provider.ethereum_tester.backend  # type: ignore[attr-defined]
        self._chain: Any = backend.chain
        self.rewind()

    @property
    def block(self) -> int:
        """The block in which calls are made."""
        return int(self._state.block_number)

    def advance(self, blocks: int) -> None:
        """Let blocks pass; without it every call is in the same block."""
        header = self._vm.get_header().copy(block_number=self.block + blocks)
        self._state.execution_context = self._vm.create_execution_context(header, [], self._vm.chain_context)

    def rewind(self) -> None:
        """Back to how the chain is. The state is a new one: py-evm's own gets slower with each account it has seen."""
        self._vm: Any = self._chain.get_vm()
        self._state: Any = self._vm.state

    def become_chain(self, chain_id: int) -> None:
        """Go on as a chain with another number, as after a split."""
        context = self._vm.create_execution_context(self._vm.get_header(), [], ChainContext(chain_id))
        self._state.execution_context = context

    def call(self, target: str, function: str, *arguments: Any, sender: str) -> Answer:
        """Call `function`, which is written as `name(type,type)`; nothing changes when it is refused."""
        selector, types = _interface(function)
        to, caller = Address(address_bytes(target)), Address(address_bytes(sender))
        data = selector + encode(types, arguments)
        message = Message(gas=GAS, to=to, sender=caller, value=0, data=data, code=self._state.get_code(to))
        transaction = self._state.get_transaction_context_class()(gas_price=0, origin=caller)
        computation = self._state.computation_class.apply_message(self._state, message, transaction)
        if computation.is_error:
            return Answer(b"", [], explain(computation.output).reason)
        logs = [(checksum_address(emitter), _words(topics)) for emitter, topics, _ in computation.get_log_entries()]
        return Answer(computation.output, logs, None)

    def stored(self, contract: str, place: int) -> int:
        """A word of a contract's storage; much quicker than a call."""
        return int(self._state.get_storage(address_bytes(contract), place))


def _words(numbers: tuple[int, ...]) -> list[bytes]:
    return [number.to_bytes(32, "big") for number in numbers]


@cache
def _interface(function: str) -> tuple[bytes, list[str]]:
    types = function[function.index("(") + 1 : -1]
    return keccak256(function.encode())[:4], types.split(",") if types else []
