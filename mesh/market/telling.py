"""How a provider is, for whoever asks it over Zenoh."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

import mesh
from schemas.status import ALIVE, MarketStatus, Status

if TYPE_CHECKING:
    import zenoh

    from mesh.chain import Chain
    from mesh.market.book import OrderBook
    from mesh.market.earnings import EarningsLedger
    from mesh.market.sending import Sending
    from mesh.market.watching import Watching
    from schemas.rpc import Nothing


class StatusService:
    """`status` of the provider of `lighthouse` (ENS name). It changes nothing, and asks neither chain nor network."""

    def __init__(
        self,
        session: zenoh.Session,
        chain: Chain,
        lighthouse: str,
        *,
        book: OrderBook,
        books: EarningsLedger,
        sending: Sending,
        watching: Watching,
    ) -> None:
        self._session = session
        self._chain = chain
        self._lighthouse = lighthouse
        self._book = book
        self._books = books
        self._sending = sending
        self._watching = watching
        self._began = time.monotonic()

    async def status(self, _request: Nothing) -> Status:
        """How it is now."""
        assert self._chain.account is not None
        earned = self._books.earnings()
        return Status(
            role="provider",
            address=self._chain.account.address,
            version=mesh.__version__,
            zenoh_id=str(self._session.zid()),
            lighthouse=self._lighthouse,
            parts=self.parts(),
            head=self._watching.head,
            chain_id=self._chain.chain_id,
            xrt=self._chain.xrt,
            uptime=round(time.monotonic() - self._began, 3),
            market=MarketStatus(
                open_orders=len(self._book),
                created=earned.created,
                finalized=earned.finalized,
                rejected=earned.rejected,
                gas_used=earned.gas_used,
                spent=earned.spent,
                fees=earned.fees,
                minted=earned.minted,
            ),
        )

    def parts(self) -> dict[str, str]:
        """The state of each part: that its transactions go through, and that it reads the chain."""
        return {
            "transactions": self._sending.waits_for or ALIVE,
            "listener": "waits for the node" if self._watching.waits else ALIVE,
        }
