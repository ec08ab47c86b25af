"""The figures of a provider: its market, and its stake."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from mesh.chain.metrics import Asked, reading_families
from mesh.network.metrics import message_families
from mesh.telemetry.metrics import MetricFamily, by_label, counter, gauge, labelled

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from mesh.chain import Chain
    from mesh.market.book import OrderBook
    from mesh.market.earnings import EarningsLedger
    from mesh.market.sending import Sending
    from mesh.market.watching import Watching
    from mesh.network import Channel, Subscription


class MarketMetrics:
    """The figures of the provider of `channel`, each with its lighthouse. What is said of its account is not here."""

    def __init__(
        self,
        channel: Channel,
        chain: Chain,
        *,
        subscriptions: Sequence[Subscription[Any]],
        book: OrderBook,
        books: EarningsLedger,
        sending: Sending,
        watching: Watching,
    ) -> None:
        self._channel = channel
        self._chain = chain
        self._subscriptions = subscriptions
        self._book = book
        self._books = books
        self._sending = sending
        self._watching = watching
        self._stake = Asked(self._ask_stake)

    async def measure(self) -> tuple[MetricFamily, ...]:
        """The figures now."""
        families = (
            *message_families(self._subscriptions),
            *self._market(),
            *self._money(),
            *reading_families(head=self._watching.head, read_at=self._watching.read_at),
            *await self._stake.measure(),
        )
        return labelled(families, lighthouse=self._channel.lighthouse)

    def _market(self) -> Iterable[MetricFamily]:
        seen, rejected = self._books.turnover(), self._books.earnings().rejected
        undone = {"created": seen.taken_back.created, "finalized": seen.taken_back.finalized}
        return (
            gauge("aira_orders_open", "Orders in the book", len(self._book)),
            counter("aira_matches_total", "Pairs of a demand and an offer that agree", seen.matches),
            counter("aira_contracts_created_total", "Contracts that this provider has made", seen.entered.created),
            counter("aira_contracts_finalized_total", "Contracts that it has finalized", seen.entered.finalized),
            by_label(
                "aira_contracts_taken_back_total", "counter", "What of that the chain has taken back", "step", undone
            ),
            by_label(
                "aira_rejections_total", "counter", "Orders and Results that could not be used", "reason", rejected
            ),
            gauge("aira_transactions_waiting", "Contracts to make or to finalize that wait", self._sending.waiting),
        )

    def _money(self) -> Iterable[MetricFamily]:
        seen = self._books.turnover()
        undone = {"fees": seen.taken_back.fees, "minted": seen.taken_back.minted}
        return (
            counter("aira_fees_earned_wn_total", "Fees of the contracts made, wn", seen.entered.fees),
            counter("aira_minted_wn_total", "XRT minted for the gas of finalizing, wn", seen.entered.minted),
            by_label(
                "aira_earnings_taken_back_wn_total",
                "counter",
                "What of that the chain has taken back, wn",
                "of",
                undone,
            ),
        )

    async def _ask_stake(self) -> Iterable[MetricFamily]:
        assert self._chain.account is not None
        assert self._channel.address is not None
        state = await self._chain.lighthouses.get(self._channel.address)
        own = self._chain.account.address
        return (
            gauge("aira_stake_wn", "What this provider has staked at the lighthouse, wn", state.stakes.get(own, 0)),
            gauge("aira_turn", "1 while it is this provider's turn, 0 otherwise", float(state.current == own)),
            gauge("aira_lighthouse_providers", "Providers with a stake at the lighthouse", len(state.stakes)),
        )
