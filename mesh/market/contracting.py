"""Making contracts of orders that agree, and ending them by their Results: a provider's work on the chain."""

from __future__ import annotations

import logging
from functools import partial
from typing import TYPE_CHECKING, Any, Protocol

from mesh.chain import NodeUnreachable, RequestRefused, Reverted
from mesh.errors import AiraError, InputError
from mesh.market.faults import at_fault, word_for
from mesh.market.patience import Patience, may_pass
from mesh.telemetry.context import liability_context, log_event

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable

    from mesh.chain import Chain
    from mesh.market.book import Match, Order
    from mesh.market.earnings import EarningsLedger
    from mesh.market.sending import Sending
    from mesh.market.settled import SettledMessages
    from schemas import Result, Verified

log = logging.getLogger(__name__)


class ProviderCallbacks(Protocol):
    """Where orders and Results come from, and go back to."""

    def put_back(self, order: Verified[Order]) -> None:
        """An order that was matched stays in the market: its counterpart was to blame."""

    def reject(self, message: Verified[Any], reason: str, detail: str) -> None:
        """A message can't be used: for its sender the machine-readable reason, and words for people."""

    def forget(self, result: Verified[Result]) -> None:
        """Nothing came of a Result this time: it counts when it is sent again."""


class Contracting:
    """The contracts of the lighthouse at the address `lighthouse`. Whatever is asked for is done in its turn."""

    def __init__(
        self,
        chain: Chain,
        lighthouse: str,
        desk: ProviderCallbacks,
        *,
        sending: Sending,
        books: EarningsLedger,
        used: SettledMessages,
    ) -> None:
        self._chain = chain
        self._lighthouse = lighthouse
        self._desk = desk
        self._sending = sending
        self._books = books
        self._used = used

    def make(self, match: Match) -> None:
        """Make a contract of a pair; what can't become one leaves the market, the other order stays."""
        self._sending.put(partial(self._make, match, Patience()))

    def end(self, result: Verified[Result]) -> None:
        """Finalize a contract by its Result."""
        self._sending.put(partial(self._end, result, Patience()))

    async def _make(self, match: Match, patience: Patience) -> None:
        demand, offer = match
        create = partial(self._chain.liabilities.create, self._lighthouse, demand.message, offer.message)
        try:
            created = await self._sending.send(partial(patience.attempt, create))
        except Reverted as error:
            self._books.failed(error)
            if not self._again(partial(self._make, match, patience), patience, error):
                await self._part(match, gone=at_fault(match, error.reason, error.arguments), error=error)
        except (NodeUnreachable, RequestRefused) as error:
            if not self._again(partial(self._make, match, patience), patience, error):
                await self._part(match, gone=match, error=error)
        except InputError as error:
            await self._part(match, gone=match, error=error)
        else:
            self._books.made(created, fee=offer.message.lighthouse_fee)
            self._used.add(created.liability, demand, offer)
            known = log_event("unnamed", demand=demand.hash.hex(), offer=offer.hash.hex(), gas=created.gas_used)
            with liability_context(created.liability):
                log.info("created, gas %d", created.gas_used, extra=known)

    def _again(
        self,
        work: Callable[[], Awaitable[None]],
        patience: Patience,
        error: NodeUnreachable | RequestRefused | Reverted,
    ) -> bool:
        """Try again later what may have failed for a passing reason; False when that was done often enough."""
        pause = patience.pause() if may_pass(error) else None
        return pause is not None and self._sending.put_later(work, after=pause, because=error)

    async def _part(self, match: Match, *, gone: tuple[Verified[Order], ...], error: AiraError) -> None:
        """Reject the orders that are to blame, and put back the other one, unless it was used meanwhile."""
        for order in match:
            if order in gone:
                self._desk.reject(order, _reason(error), str(error))
            elif not await self._sending.ask(partial(self._is_used, order)):
                self._desk.put_back(order)

    async def _is_used(self, order: Verified[Order]) -> bool:
        try:
            if order.message.generation == 3:
                return await self._chain.liabilities.is_order_used(order.hash, order.signer)
            return await self._chain.liabilities.next_nonce(order.signer) > int(order.message.nonce)
        except RequestRefused:
            return False  # the contracts will say so when it is matched

    async def _end(self, result: Verified[Result], patience: Patience) -> None:
        with liability_context(result.message.liability):
            await self._finalize(result, patience)

    async def _finalize(self, result: Verified[Result], patience: Patience) -> None:
        message = result.message
        finalize = partial(self._chain.liabilities.finalize, self._lighthouse, message)
        try:
            settled = await self._sending.send(partial(patience.attempt, finalize))
        except Reverted as error:
            self._books.failed(error)
            again = self._again(partial(self._end, result, patience), patience, error)
            if not again and error.reason != "AlreadyFinalized":
                self._desk.reject(result, _reason(error), str(error))
        except (NodeUnreachable, RequestRefused) as error:
            if not self._again(partial(self._end, result, patience), patience, error):
                # Perhaps not the Result's fault, and whoever is to be paid goes on sending it.
                self._desk.reject(result, _reason(error), str(error))
                self._desk.forget(result)
        else:
            self._books.ended(message.liability, settled)
            self._used.add(message.liability, result)
            known = log_event("unnamed", gas=settled.gas_used)
            log.info("finalized, success %s, gas %d", message.success, settled.gas_used, extra=known)


def _reason(error: AiraError) -> str:
    """The machine-readable word for why something was refused."""
    return word_for(error.reason if isinstance(error, Reverted) else type(error).__name__)
