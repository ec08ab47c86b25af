"""What was read of a chain last: enough to notice that it was reorganised, and to say what did not happen after all."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final

import msgspec

from mesh.chain.events import (
    Approval,
    ChainEvent,
    Current,
    Finalized,
    NewLiability,
    NewLighthouse,
    Offline,
    Online,
    Transfer,
)
from mesh.errors import ConfigurationError, InputError

DEPTH: Final = 12
"""Blocks behind the head that are remembered unless told otherwise; public chains reorganise one or two."""

KINDS: Final[dict[str, type[ChainEvent]]] = {
    kind.__name__: kind
    for kind in (NewLiability, Finalized, NewLighthouse, Transfer, Approval, Online, Offline, Current)
}


@dataclass(frozen=True, slots=True)
class Remembered:
    """A block that was read: its number, its hash (32 bytes) and the events that were told of it."""

    block_number: int
    block_hash: bytes
    events: tuple[ChainEvent, ...]


class History:
    """The last blocks that one reader of events was told of, back to `depth` blocks behind the newest.

    Every block with events is remembered, and of those without at least the newest that was read. One more is kept
    below the depth: what a reorganisation of the whole depth goes back to. Give the same history to `Chain.events`
    again when reading is taken up; `encode` and `decode` keep it across restarts, next to the reader's cursor.
    """

    def __init__(self, depth: int = DEPTH) -> None:
        if depth < 1:
            raise ConfigurationError("a history remembers at least one block")
        self.depth = depth
        self._blocks: list[Remembered] = []

    @property
    def blocks(self) -> tuple[Remembered, ...]:
        """The remembered blocks, the oldest first."""
        return tuple(self._blocks)

    def remember(self, block: Remembered) -> None:
        """Add a block, which is newer than all that are remembered, and forget those that are too old by now."""
        if self._blocks and block.block_number <= self._blocks[-1].block_number:
            return
        self._blocks.append(block)
        oldest = block.block_number - self.depth
        while len(self._blocks) > 1 and self._blocks[1].block_number <= oldest:
            del self._blocks[0]

    def forget_above(self, block_number: int) -> tuple[ChainEvent, ...]:
        """Forget the blocks above a number; their events, the newest first."""
        gone = [block for block in self._blocks if block.block_number > block_number]
        del self._blocks[len(self._blocks) - len(gone) :]
        return tuple(event for block in reversed(gone) for event in reversed(block.events))

    def encode(self) -> bytes:
        """The history as JSON."""
        blocks = [
            (block.block_number, block.block_hash.hex(), [(type(event).__name__, event) for event in block.events])
            for block in self._blocks
        ]
        return msgspec.json.encode({"depth": self.depth, "blocks": blocks})

    @classmethod
    def decode(cls, data: bytes) -> History:
        """What `encode` made. Raises `InputError` for anything else."""
        try:
            held = msgspec.json.decode(data)
            history = cls(held["depth"])
            for number, block_hash, events in held["blocks"]:
                decoded = tuple(_event(*event) for event in events)
                history.remember(Remembered(int(number), bytes.fromhex(block_hash), decoded))
        except (msgspec.MsgspecError, KeyError, TypeError, ValueError, ConfigurationError) as error:
            raise InputError(f"this is no history of a chain ({error})", hint="begin with an empty one") from None
        return history


def _event(kind: str, members: Any) -> ChainEvent:
    return msgspec.convert(members, KINDS[kind])
