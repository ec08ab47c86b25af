"""Transfers and approvals of tokens that concern an account, told on its keys."""

from __future__ import annotations

from collections import deque
from typing import TYPE_CHECKING, Final

from mesh.chain import Approval, Transfer
from schemas.keys import EthEventKey
from schemas.rpc import ApprovalEvent, TransferEvent

if TYPE_CHECKING:
    from collections.abc import Callable

    from schemas import Record

REMEMBERED: Final = 1_000
"""Events that were taken back, and may be told again."""


class TokenEvents:
    """Puts each event of `account` on `aira/agent/{account}/eth/event/transfer` or `…/approval`, by `put`.

    Each is told once: one that a reorganisation takes back and brings again is not told again. What is told can't be
    unsaid, so one that does not come again was told in vain; and after a crash in the middle of a block, the events of
    that block are told again. A balance is asked of the chain, not added up of these.
    """

    def __init__(self, put: Callable[[str, bytes], None], account: str) -> None:
        self._put = put
        self._account = account
        self._taken_back: deque[Transfer | Approval] = deque(maxlen=REMEMBERED)

    def tell(self, event: Transfer | Approval) -> None:
        """Tell of an event, if it concerns the account."""
        parties, record = _record(event)
        if self._account not in parties:
            return
        if event in self._taken_back:
            self._taken_back.remove(event)
            return
        kind: Final = "transfer" if isinstance(event, Transfer) else "approval"
        self._put(str(EthEventKey(self._account, kind)), record.encode())

    def take_back(self, event: Transfer | Approval) -> None:
        """The chain was reorganised: the event did not happen, or happens again in another block."""
        if self._account in _record(event)[0]:
            self._taken_back.append(event)


def _record(event: Transfer | Approval) -> tuple[tuple[str, str], Record]:
    """Who an event concerns, and what is told of it."""
    match event:
        case Transfer(sender, recipient, value):
            return (sender, recipient), TransferEvent(sender, recipient, value)
        case Approval(owner, spender, value):
            return (owner, spender), ApprovalEvent(owner, spender, value)
