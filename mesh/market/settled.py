"""What became of messages on the chain, for as long as the chain may take it back."""

from __future__ import annotations

from collections import OrderedDict
from typing import TYPE_CHECKING, Any, Final

if TYPE_CHECKING:
    from schemas import Verified

REMEMBERED: Final = 4096
"""Liabilities whose messages are kept; the chain replaces its last blocks only."""


class SettledMessages:
    """The orders and the Result that each of the latest liabilities was made of and ended with."""

    def __init__(self) -> None:
        self._messages: OrderedDict[str, list[Verified[Any]]] = OrderedDict()

    def add(self, liability: str, *messages: Verified[Any] | None) -> None:
        """These messages (None: not known here) had their effect at the liability's address."""
        kept = self._messages.setdefault(liability, [])
        kept.extend(message for message in messages if message is not None and message not in kept)
        if len(self._messages) > REMEMBERED:
            self._messages.popitem(last=False)

    def pop(self, liability: str, *kinds: type[Any]) -> list[Verified[Any]]:
        """Take out the messages of these kinds, in the order in which they were added."""
        kept = self._messages.get(liability, [])
        taken = [message for message in kept if isinstance(message.message, kinds)]
        kept[:] = [message for message in kept if message not in taken]
        return taken
