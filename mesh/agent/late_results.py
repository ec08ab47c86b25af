"""Results that no provider finalizes in time are finalized by the agent that owes them."""

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
"""A Result is late when a quarter of the blocks before the refund are left …"""
LEAST_BLOCKS: Final = 20
"""… or fewer than this."""
SOON: Final = 3
"""Blocks that leave a Result unsettled before the chain is asked when it would be late, and between two attempts."""
JUDGED: Final = frozenset({"NotTheValidator", "RefusedByValidator"})
"""How the contracts refuse a Result that only a validator can finalize."""
NOT_OURS: Final = "WrongSigner"
"""How they refuse a Result of another account."""
NEVER: Final = 2**63


class LateResults:
    """Finalizes liabilities by the account's own Results before they can be refunded, if no provider does.

    The original contracts offer no finalization without a turn; there it does nothing.
    """

    def __init__(self, parts: AgentComponents) -> None:
        self._parts = parts
        self._liabilities = parts.chain.liabilities
        self._late_from: dict[str, int] = {}  # block, by liability
        self._since: dict[str, int] = {}  # the block at which its Result was seen first, by liability

    async def run(self) -> None:
        """Look at the unsettled Results after each block, until cancelled."""
        head = self._parts.chain_head
        while True:
            unsettled = await self._parts.ledger.outbox(head=head.head)
            results = [decode(one.payload) for one in unsettled if one.kind == Result.kind]
            waiting = {result.liability: result for result in results if isinstance(result, Result)}
            self._late_from = {address: block for address, block in self._late_from.items() if address in waiting}
            self._since = {address: self._since.get(address, head.head) for address in waiting}
            for address, result in waiting.items():
                with liability_context(address):
                    await self._finalize_if_late(result)
            await head.reached(head.head + 1)

    async def _finalize_if_late(self, result: Result) -> None:
        address, head = result.liability, self._parts.chain_head.head
        try:
            if address not in self._late_from:
                if head - self._since[address] < SOON:
                    return
                refundable = await self._liabilities.refundable_from(address)
                self._late_from[address] = refundable - max(LEAST_BLOCKS, (refundable - self._since[address]) // SHARE)
            if head < self._late_from[address]:
                return
            settled = await self._liabilities.finalize_without_turn(result)
        except (NodeUnreachable, RequestRefused, NotALiability) as error:
            log.debug("looking at the result again after the next block: %s", error)
        except (NotOffered, Reverted) as error:
            is_final = isinstance(error, NotOffered) or error.reason in (*JUDGED, NOT_OURS)
            # Else somebody's transaction may be pending that finalizes it, and fail.
            self._late_from[address] = NEVER if is_final else head + SOON
            log.debug("the contract is not finalized by its result: %s", error)
            if isinstance(error, Reverted) and error.reason in JUDGED:
                facts = log_event("verdict-late", code=error.reason)
                log.warning("the validator has not judged the result, and the cost can be refunded soon", extra=facts)
        except ChainError as error:
            facts = log_event("late-result-waits", code=error.code)
            log.warning("no provider finalized the contract, and finalizing it failed: %s", error, extra=facts)
        else:
            self._late_from[address] = NEVER
            facts = log_event("late-result-finalized", success=result.success, gas=settled.gas_used)
            log.warning("finalized without a provider, because none did in time", extra=facts)
