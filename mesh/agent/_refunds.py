"""Takes back what the account's contracts cost when nobody has ended them in time."""

from __future__ import annotations

import asyncio
import logging
from typing import TYPE_CHECKING, Final

from mesh.base.flood import BoundedDict
from mesh.base.log_context import liability_context, log_event
from mesh.chain import NodeUnreachable, NotALiability, NotOffered, RequestRefused, Reverted
from mesh.errors import ChainError

if TYPE_CHECKING:
    from mesh.agent.components import AgentComponents

log = logging.getLogger(__name__)

FIRST_LOOK: Final = 30
"""Blocks after which the chain is asked from when on a contract that is still open can be refunded."""
AGAIN: Final = 20
"""Blocks between two attempts while the account lacks ETH, or gas is too expensive."""


class DueRefunds:
    """Refunds the contracts of which the account is the promisee, as soon as that is possible.

    The original contracts offer no refund; there it does nothing. Blocks are as contracts count them.
    """

    def __init__(self, parts: AgentComponents) -> None:
        self._parts = parts
        self._look_at: dict[str, int] = {}
        """By contract: the first block for whose transactions it is looked at."""
        self._ended: BoundedDict[str, None] = BoundedDict(256)
        """The latest that have ended, which a reorganisation may revert."""

    def created(self, liability: str, *, earlier: bool = False) -> None:
        """A contract of the account exists, perhaps again; it may be one of an `earlier` run."""
        self._look_at[liability] = 0 if earlier else self._parts.chain_head.contract_block + FIRST_LOOK

    def ended(self, liability: str) -> None:
        """A contract has ended, or was reverted."""
        if self._look_at.pop(liability, None) is not None:
            self._ended[liability] = None

    def end_reverted(self, liability: str) -> None:
        """A reorganisation reverted the end of a contract."""
        if liability in self._ended:
            self.created(liability)

    async def run(self) -> None:
        """Look after each block, until cancelled."""
        head = self._parts.chain_head
        for _, address in await self._parts.ledger.contracts("demand"):
            self.created(address, earlier=True)
        while True:
            due = [address for address, block in self._look_at.items() if head.contract_block + 1 >= block]
            await asyncio.gather(*map(self._look, due))
            await head.reached(head.head + 1)

    async def _look(self, address: str) -> None:
        with liability_context(address):
            following = await self._refund_if_due(address)
        if address not in self._look_at:
            return
        if following is None:
            self.ended(address)
        else:
            self._look_at[address] = following

    async def _refund_if_due(self, address: str) -> int | None:
        """Refund a contract if that is possible now. Returns when to look again; None if never."""
        liabilities, following = self._parts.chain.liabilities, self._parts.chain_head.contract_block + 2
        try:
            state = await liabilities.refund_state(address)
            if state.is_finalized:
                return None
            if not state.is_refundable:
                return state.refundable_from
            settled = await liabilities.refund(address)
        except (NodeUnreachable, RequestRefused, Reverted) as error:
            # Perhaps its end is in a block that was not read yet, or the next block is the first that allows it.
            log.debug("looking at the refund again after the next block: %s", error)
            return following
        except (NotOffered, NotALiability):  # or a reorganisation has reverted it
            return None
        except ChainError as error:
            facts = log_event("refund-waits", code=error.code)
            log.warning("nobody ended the contract in time, and taking its cost back failed: %s", error, extra=facts)
            return following + AGAIN
        facts = log_event("refund-taken", gas=settled.gas_used)
        log.warning("nobody ended the contract in time, so its cost was taken back", extra=facts)
        return None
