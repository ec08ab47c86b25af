"""Takes back what contracts cost when nobody has ended them in time."""

from __future__ import annotations

import asyncio
import logging
from functools import partial
from typing import TYPE_CHECKING, Final, NamedTuple

from mesh.base.flood import BoundedDict
from mesh.base.log_context import liability_context, log_event
from mesh.chain import NodeUnreachable, NotALiability, NotOffered, RequestRefused, Reverted
from mesh.chain.following import READ_ERRORS
from mesh.errors import ChainError
from schemas import ZERO_ADDRESS

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Iterable

    from mesh.base.outage_log import OutageLog
    from mesh.chain import Chain
    from mesh.role.following import ChainHead
    from schemas import Liability

log = logging.getLogger(__name__)

TOO_EARLY: Final = "RefundTooEarly"
"""The contract's error before the block from which on it can be refunded."""


class RefundPace(NamedTuple):
    """How often a contract that is still open is looked at, in seconds."""

    first: float = 360.0
    """After which the chain is asked from when on it can be refunded."""
    again: float = 240.0
    """Between two attempts while the account lacks ETH, gas is too expensive, or the contract refuses."""


REFUND_PACE: Final = RefundPace()


class DueRefunds:
    """Refunds contracts as soon as that is possible: a promisee its own, a provider those whose permits it has carried.

    Not those that have cost nothing. The original contracts offer no refund; there it does nothing. Blocks are as
    contracts count them. `earlier` returns the contracts (addresses) of earlier runs; with
    `patience` it lets others go first for so many blocks.
    """

    def __init__(
        self,
        chain: Chain,
        head: ChainHead,
        outages: OutageLog,
        earlier: Callable[[], Awaitable[Iterable[str]]],
        *,
        patience: int = 0,
    ) -> None:
        self._patience = patience
        self._chain, self._head, self._outages, self._earlier = chain, head, outages, earlier
        self._look_at: dict[str, int] = {}
        """By contract: the first block for whose transactions it is looked at."""
        self._ended: BoundedDict[str, None] = BoundedDict(256)
        """The latest that have ended, which a reorganisation may revert."""

    def created(self, liability: Liability) -> None:
        """A contract of the account exists, perhaps again."""
        if _has_cost(liability):
            self.watch(liability.address)

    def ended(self, address: str) -> None:
        """A contract has ended, or was reverted."""
        if self._look_at.pop(address, None) is not None:
            self._ended[address] = None

    def end_reverted(self, address: str) -> bool:
        """A contract exists whose end, or whose creation, a reorganisation has reverted; whether it was watched."""
        if address not in self._ended:
            return False
        del self._ended[address]
        self.watch(address)
        return True

    async def run(self) -> None:
        """Look after each block, until cancelled."""
        head = self._head
        await self._take_up_earlier()
        while True:
            due = [address for address, block in self._look_at.items() if head.contract_block + 1 >= block]
            await asyncio.gather(*map(self._look, due))
            await head.reached(head.head + 1)

    def watch(self, address: str) -> None:
        """Look at a contract from its time on."""
        self._look_at[address] = self._head.contract_block + self._blocks_in(REFUND_PACE.first)

    def _blocks_in(self, seconds: float) -> int:
        return self._chain.node.profile.blocks_in(seconds)

    async def _take_up_earlier(self) -> None:
        """Look at the contracts of earlier runs that are still open."""
        addresses = list(await self._earlier())
        read = partial(self._chain.liabilities.find_open, addresses)
        found = await self._chain.retrying(read, outages=self._outages, errors=READ_ERRORS)
        for address in addresses:
            if address not in found:
                self._ended[address] = None
            elif _has_cost(found[address]):
                self._look_at.setdefault(address, 0)

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
        liabilities, following = self._chain.liabilities, self._head.contract_block + 2
        try:
            state = await liabilities.refund_state(address)
            if state.is_finalized:
                return None
            if not state.is_refundable:
                return state.refundable_from + self._patience
            settled = await liabilities.refund(address)
        except (NodeUnreachable, RequestRefused) as error:
            log.debug("looking at the refund again after the next block: %s", error)
            return following
        except Reverted as error:  # perhaps its end is in a block that was not read yet
            log.debug("the contract refuses the refund: %s", error)
            return following if error.reason == TOO_EARLY else following + self._blocks_in(REFUND_PACE.again)
        except (NotOffered, NotALiability):  # or a reorganisation has reverted it
            return None
        except ChainError as error:
            facts = log_event("refund-waits", code=error.code)
            log.warning("nobody ended the contract in time, and taking its cost back failed: %s", error, extra=facts)
            return following + self._blocks_in(REFUND_PACE.again)
        facts = log_event("refund-taken", gas=settled.gas_used)
        log.warning("nobody ended the contract in time, so its cost was taken back", extra=facts)
        return None


def _has_cost(liability: Liability) -> bool:
    """Whether its promisee gets anything back."""
    return liability.cost > 0 or (liability.validator != ZERO_ADDRESS and liability.validator_fee > 0)
