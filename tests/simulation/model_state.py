"""The state of the modelled chain: cells that remember their earlier values, and runs that change them or not."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from tests.simulation.model_abi import ModelRevert, log_of

if TYPE_CHECKING:
    from collections.abc import Callable

    from tests.simulation.model_contracts import ModelContract

Cell = tuple[Any, ...]
"""The name of a cell: its contract's address, the variable, and the keys of mappings."""


class ModelState:
    """What all contracts and accounts have, at each height: reorganisations go back, calls ask about the past."""

    def __init__(self) -> None:
        self.head = 0
        self._cells: dict[Cell, list[tuple[int, Any]]] = {}
        self._changed: dict[int, set[Cell]] = {}

    def get(self, cell: Cell, default: Any, height: int) -> Any:
        """The value of a cell after the block at `height`."""
        for changed, value in reversed(self._cells.get(cell, ())):
            if changed <= height:
                return value
        return default

    def apply(self, height: int, writes: dict[Cell, Any]) -> None:
        """Change cells in the block at `height`, which is the highest so far."""
        changed = self._changed.setdefault(height, set())
        for cell, value in writes.items():
            values = self._cells.setdefault(cell, [])
            if values and values[-1][0] == height:
                values[-1] = (height, value)
            else:
                values.append((height, value))
                changed.add(cell)

    def rewind(self, height: int) -> None:
        """Undo the blocks after `height`."""
        for number in [number for number in self._changed if number > height]:
            for cell in self._changed.pop(number):
                values = self._cells[cell]
                while values and values[-1][0] > height:
                    values.pop()


class ModelRun:
    """One transaction or call, in the block after `height`. What it writes counts once it is applied.

    With `follows`, it sees what earlier transactions of its block have done.
    """

    def __init__(self, state: ModelState, height: int, chain_id: int, *, follows: bool = False) -> None:
        self.block = height + 1
        self.chain_id = chain_id
        self.writes: dict[Cell, Any] = {}
        self.logs: list[tuple[bytes, list[bytes], bytes]] = []
        self._state = state
        self._height = height + follows

    def get(self, *cell: Any, default: Any = 0) -> Any:
        """The value of a cell."""
        if cell in self.writes:
            return self.writes[cell]
        return self._state.get(cell, default, self._height)

    def set(self, *cell_and_value: Any) -> None:
        """Change a cell: the last argument is its value."""
        *cell, value = cell_and_value
        self.writes[tuple(cell)] = value

    def log(self, address: bytes, name: str, *values: Any) -> None:
        """Emit an event."""
        self.logs.append((address, *log_of(name, values)))

    def call(self, sender: bytes, to: bytes, data: bytes, *, value: int = 0) -> bytes:
        """Call an account. Raises `ModelRevert`."""
        found = self.contract(sender, to, data)
        if found is None:
            return b""
        if value:
            raise ModelRevert
        return found.answer()

    def attempt(self, sender: bytes, to: bytes, data: bytes) -> bool:
        """Call an account; if that reverts, nothing has changed, and the answer is False."""
        writes, logs = dict(self.writes), len(self.logs)
        try:
            self.call(sender, to, data)
        except ModelRevert:
            self.writes = writes
            del self.logs[logs:]
            return False
        return True

    def contract(self, sender: bytes, to: bytes, data: bytes = b"") -> ModelContract | None:
        """The contract at an address, called by `sender`; None if there is none."""
        made: tuple[Callable[..., ModelContract], bytes] | None = self.get(to, "contract", default=None)
        return None if made is None else made[0](self, to, sender, data)

    def code(self, address: bytes) -> bytes:
        """The code at an address; of contracts that are no clones, without their immutables."""
        made = self.get(address, "contract", default=None)
        return b"" if made is None else made[1]
