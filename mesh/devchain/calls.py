"""Calls and estimates: runs of the EVM whose changes are forgotten."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Any, Final

from eth.exceptions import Revert
from eth.vm.spoof import SpoofTransaction
from eth_utils.exceptions import ValidationError

from mesh.chain.reverts import REVERTED
from mesh.devchain.bounded_vm import GAS_LIMIT, bounded
from mesh.devchain.jsonrpc import SERVER_ERROR, RpcError, parse_data, parse_quantity
from mesh.flood import forget_oldest

if TYPE_CHECKING:
    from eth.abc import BlockHeaderAPI, ChainAPI, ComputationAPI

CALL_STIPEND: Final = 2_300
"""Gas that a value transfer passes on for free; an estimate leaves room for it, as geth's does."""

ANSWERS: Final = 256
"""Answers to calls that are kept, and the most bytes of a call and its answer: clients often ask the same."""
LONGEST_KEPT: Final = 16_384

Call = dict[str, Any]
"""The fields of a call by their JSON-RPC names, parsed: from, to, data (bytes), value, gas (int)."""


class Calls:
    """Runs calls on a chain. Several threads may use it at once, each run in a state of its own."""

    def __init__(self, chain: ChainAPI, *, run_seconds: float) -> None:
        self._chain: Any = chain
        self._run_seconds = run_seconds
        self._answers: dict[tuple[Any, ...], bytes] = {}
        """What calls have returned, by block, second and call: a contract may ask for the time."""

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
        if len(answer) + len(fields["data"]) <= LONGEST_KEPT:
            self._answers[asked] = answer
            forget_oldest(self._answers, ANSWERS)
        return answer

    def estimate(self, fields: Call, height: int) -> int:
        """Gas limit with which a transaction goes through; raises as `call` does.

        What a run with all gas used; if it calls others, or that is not enough, with the 64th part that a call inside
        keeps back (EIP-150) and the stipend; else, as geth does, a search up to the whole limit, to within a 64th.
        """
        with bounded(self._run_seconds):
            return self._search_gas(fields, height, limit=_gas_of(fields))

    def _search_gas(self, fields: Call, height: int, *, limit: int) -> int:
        computation = self._run(fields, height, gas=limit)
        _raise_if_failed(computation)
        used = limit - int(computation.get_gas_remaining())
        low, with_kept = used - 1, (used + CALL_STIPEND) * 64 // 63
        for attempt in (with_kept,) if computation.children else (used, with_kept):
            if attempt >= limit:
                return limit
            if self._suffices(fields, height, gas=attempt):
                return attempt
            low = attempt
        high = limit
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
                raise RpcError(SERVER_ERROR, str(error)) from None
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
    raise RpcError(SERVER_ERROR, f"{type(computation.error).__name__}: {computation.error}")
