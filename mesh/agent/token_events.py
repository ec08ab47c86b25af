"""Events of an account's tokens, published on its keys."""

from __future__ import annotations

from collections import deque
from typing import TYPE_CHECKING, Final

from mesh.chain import Approval, Transfer
from schemas.agent_keys import EthEventKey
from schemas.rpc import ApprovalEvent, TransferEvent

if TYPE_CHECKING:
    from collections.abc import Callable

    from schemas import Record

REVERTED_KEPT: Final = 1_000
"""Most reverted token events that are remembered, because they may happen again."""


class TokenEvents:
    """Publishes token events of `account` on `aira/agent/{account}/eth/event/transfer` or `…/approval`, with `put`.

    An event that is reverted and happens again is published once. One that does not happen again was published in vain,
    and after a crash in the middle of a block its events are published again: read balances from the chain, don't add
    up events.
    """

    def __init__(self, put: Callable[[str, bytes], None], account: str) -> None:
        self._put = put
        self._account = account
        self._reverted: deque[Transfer | Approval] = deque(maxlen=REVERTED_KEPT)

    def publish(self, event: Transfer | Approval) -> None:
        """Publish an event if it concerns the account and was not published before it was reverted."""
        parties, record = _record(event)
        if self._account not in parties:
            return
        if event in self._reverted:
            self._reverted.remove(event)
            return
        kind: Final = "transfer" if isinstance(event, Transfer) else "approval"
        self._put(str(EthEventKey(self._account, kind)), record.encode())

    def revert(self, event: Transfer | Approval) -> None:
        """A reorganisation reverted the event; it may happen again in another block."""
        if self._account in _record(event)[0]:
            self._reverted.append(event)


def _record(event: Transfer | Approval) -> tuple[tuple[str, str], Record]:
    """The accounts that an event concerns, and its record."""
    match event:
        case Transfer(sender, recipient, value):
            return (sender, recipient), TransferEvent(sender, recipient, value)
        case Approval(owner, spender, value):
            return (owner, spender), ApprovalEvent(owner, spender, value)
