"""How a provider handles withdrawals: it takes the order out of its book, and confirms the withdrawal to the maker."""

from __future__ import annotations

from typing import TYPE_CHECKING

from mesh.market.refusals import Refusal
from mesh.market.withdrawals import withdrawn_id

if TYPE_CHECKING:
    import asyncio
    from collections.abc import Callable

    from mesh.flood import Drops
    from mesh.market.book import OrderBook
    from mesh.market.liability_events import LiabilityEvents
    from mesh.market.rejections import RejectionPublisher
    from mesh.market.versions import OrderVersions
    from mesh.market.withdrawals import Withdrawals
    from schemas import Verified, Withdrawal


class WithdrawalSettlement:
    """Honours withdrawals for one market. Copies of what it can't promise yet are looked at again after `pause`
    (seconds)."""

    def __init__(
        self,
        withdrawals: Withdrawals,
        *,
        book: OrderBook,
        events: LiabilityEvents,
        versions: OrderVersions,
        rejections: RejectionPublisher,
        forget: Callable[..., None],
        drops: Drops,
        pause: float,
    ) -> None:
        self._withdrawals = withdrawals
        self._book = book
        self._events = events
        self._versions = versions
        self._rejections = rejections
        self._forget = forget
        self._drops = drops
        self._pause = pause

    def start(self, tasks: asyncio.TaskGroup) -> None:
        """From now on, honour what is added in tasks of this group."""
        self._tasks = tasks

    def add(self, withdrawal: Verified[Withdrawal]) -> None:
        """Honour a withdrawal: its order leaves the book, and is refused until its deadline.

        A transaction that was sent already can't be stopped.
        """
        identity = withdrawn_id(withdrawal)
        is_open = self._is_settled(identity) or self._book.stays(identity)
        if not self._withdrawals.add(withdrawal, is_open=is_open):
            self._drops.count("withdrawals", withdrawal.signer)
            self._rejections.reject(withdrawal, Refusal.FULL.value, "too many withdrawals")
            self._forget(withdrawal)
            return
        self._book.remove(identity)
        self._tasks.create_task(self._confirm(withdrawal))

    def may_promise(self, withdrawn: bytes) -> bool:
        """Whether a withdrawal is known to the end, and no transaction with its order may still succeed."""
        return self._withdrawals.is_kept(withdrawn) and not self._versions.is_undecided(withdrawn, self._events.head)

    async def _confirm(self, withdrawal: Verified[Withdrawal]) -> None:
        """Tell the maker, once the withdrawal is on the disk, that its order won't become a contract."""
        await self._withdrawals.sync()
        identity = withdrawn_id(withdrawal)
        if self.may_promise(identity) and not self._is_settled(identity):
            self._rejections.honour(withdrawal)
        else:
            self._forget(withdrawal, after=self._pause)

    def _is_settled(self, withdrawn: bytes) -> bool:
        return self._events.unconfirmed.get(withdrawn) is not None
