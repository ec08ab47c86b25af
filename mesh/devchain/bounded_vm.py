"""py-evm with a limit on the time that one run may take.

Gas alone does not bound it: py-evm needs ten seconds and more for the gas of one block. Code without end has to jump or
to call, so time is checked there.
"""

from __future__ import annotations

import threading
import time
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, Final

from eth._utils.address import force_bytes_to_address
from eth.constants import GAS_JUMPDEST
from eth.vm import mnemonics, opcode_values
from eth.vm.forks.prague import PragueVM
from eth.vm.forks.prague.computation import PragueComputation
from eth.vm.forks.prague.state import PragueState
from eth.vm.opcode import as_opcode

from mesh.devchain.jsonrpc import SERVER_ERROR, RpcError

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from eth.abc import ComputationAPI

GAS_LIMIT: Final = 30_000_000
"""Gas that a block may use, and a call."""


SLOW_PRECOMPILES: Final = (0x08, 0x0C, 0x0E, 0x0F)
"""Pairings and sums over elliptic curves, which take a second for each pair and can't be interrupted."""
MAX_PAIRING_BYTES: Final = 1_536
"""Input of such a contract: eight pairs on bn128, four on BLS12-381."""


class _RunTooLong(Exception):
    """A run used up its time. Not an error of the EVM: it ends the outermost run."""


CHECKED_RUNS: Final = 64
"""The clock is read at one of so many jumps and calls: reading a thread's clock costs as much as a few opcodes."""


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
        raise RpcError(SERVER_ERROR, f"execution aborted (timeout = {seconds:g}s)") from None
    finally:
        _limit.deadline = None


def _check_time(computation: object = None) -> None:
    _limit.checks += 1
    if _limit.checks % CHECKED_RUNS == 0 and _limit.deadline is not None and time.thread_time() > _limit.deadline:
        raise _RunTooLong


def _bounded_input(precompile: Callable[[ComputationAPI], Any]) -> Callable[[ComputationAPI], Any]:
    def run(computation: ComputationAPI) -> Any:
        if len(computation.msg.data) > MAX_PAIRING_BYTES:
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
