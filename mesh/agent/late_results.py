"""Finalizing without a provider: the Results of an agent that nobody has brought to the chain as their refund nears."""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING, Final

from mesh.chain import NodeUnreachable, NotALiability, NotOffered, RequestRefused, Reverted
from mesh.errors import ChainError
from mesh.log_context import liability_context, log_event
from schemas import Result, decode

if TYPE_CHECKING:
    from mesh.agent.components import AgentComponents

log = logging.getLogger(__name__)

SHARE: Final = 4
"""A Result is late when a quarter of the time that was left for it is left."""
LEAST_BLOCKS: Final = 20
"""It is late at this many blocks before the refund in any case."""
NEVER: Final = 2**63


class LateResults:
    """Brings the account's own Results to the chain in time, if no provider does.

    A liability can be refunded some time after its creation, and a provider may fail, or keep the others from their
    turns, until then. The original contracts offer no finalization without a turn: there, nothing is done.
    """

    def __init__(self, parts: AgentComponents) -> None:
        self._parts = parts
        self._chain = parts.chain
        self._late_from: dict[str, int] = {}
        """By liability: the block from which its Result is late."""

    async def run(self) -> None:
        """Look at the unsettled Results after each block, until cancelled."""
        head = self._parts.chain_head
        while True:
            unsettled = await self._parts.ledger.outbox(head=head.head)
            decoded = [decode(one.payload) for one in unsettled if one.kind == Result.kind]
            results = {result.liability: result for result in decoded if isinstance(result, Result)}
            self._late_from = {address: block for address, block in self._late_from.items() if address in results}
            for result in results.values():
                with liability_context(result.liability):
                    await self._finalize_if_late(result)
            await head.reached(head.head + 1)

    async def _finalize_if_late(self, result: Result) -> None:
        address, block = result.liability, self._parts.chain_head.head
        try:
            if address not in self._late_from:
                refundable = await self._chain.liabilities.refundable_from(address)
                self._late_from[address] = refundable - max(LEAST_BLOCKS, (refundable - block) // SHARE)
            if block < self._late_from[address]:
                return
            settled = await self._chain.liabilities.finalize_without_turn(result)
        except (NodeUnreachable, RequestRefused, NotALiability) as error:
            log.debug("looking at the result again after the next block: %s", error)
        except (NotOffered, Reverted) as error:
            # The originals, a liability that has ended, or one whose validator must speak first.
            self._late_from[address] = NEVER
            log.debug("the result can't be brought without a provider: %s", error)
        except ChainError as error:
            facts = log_event("late-result-waits", code=error.code)
            log.warning("no provider has brought the result, and it can't be brought now: %s", error, extra=facts)
        else:
            self._late_from[address] = NEVER
            facts = log_event("late-result-finalized", success=result.success, gas=settled.gas_used)
            log.warning("finalized without a provider, as none did in time", extra=facts)
