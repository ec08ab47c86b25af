"""The offers of an agent that answer strangers' demands: bounded for each maker and in total.

An offer is sent again until its deadline, so what strangers make an agent offer costs it and the market messages.
"""

from __future__ import annotations

from collections import Counter, OrderedDict
from typing import TYPE_CHECKING, Final

from mesh.errors import AiraError
from mesh.flood import BoundedDict
from mesh.market.versions import lasting_hash
from schemas import Offer

if TYPE_CHECKING:
    from mesh.agent.orders import TradedOrder
    from schemas import Demand

PER_MAKER: Final = 256
"""Open offers that answer demands of one maker."""
TOTAL: Final = 2048
"""Open offers that answer demands."""


class TooManyOffers(AiraError, code="too-many-offers"):
    """An agent has as many open offers as it may have, in all or for the demands of `maker`."""

    def __init__(self, maker: str) -> None:
        super().__init__(f"there are too many open offers for demands, also of {maker}", hint="try again later")
        self.maker = maker


class OpenOffers:
    """The open offers that answer demands, oldest first."""

    def __init__(self, *, per_maker: int = PER_MAKER, total: int = TOTAL) -> None:
        self._per_maker = per_maker
        self._total = total
        self._offers: OrderedDict[TradedOrder, tuple[str, bool]] = OrderedDict()
        self._makers: Counter[str] = Counter()
        self._answers: BoundedDict[str, TradedOrder] = BoundedDict(total)
        """The latest offer for each demand of generation 5, by what the demand's versions share."""

    def __len__(self) -> int:
        return len(self._offers)

    def add(self, offer: TradedOrder, maker: str, *, pays: bool) -> TradedOrder | None:
        """Count an offer for a demand of `maker`; returns one to give up for it, or None.

        Given up is the newest offer for the maker with the most (those of earlier runs count as one maker's), or the
        oldest for a demand that pays nothing. Raises `TooManyOffers`.
        """
        given_up = None
        if self._makers[maker] >= self._per_maker and maker:
            raise TooManyOffers(maker)
        if len(self._offers) >= self._total:
            given_up = self._least(maker)
            self.discard(given_up)
        self._offers[offer] = maker, pays
        self._makers[maker] += 1
        return given_up

    def answer(self, demand: Demand | None, offer: TradedOrder) -> None:
        """Remember which offer answers a demand, if it answers one of generation 5."""
        if demand is not None and demand.generation == 5:
            self._answers[lasting_hash(demand)] = offer

    def answer_to(self, demand: Demand, *, lighthouse_fee: int) -> TradedOrder | None:
        """The open offer, with this fee, that answers another version of a demand; it matches this one as well."""
        offer = self._answers.get(lasting_hash(demand)) if demand.generation == 5 else None
        if offer is None or not offer.is_open or not isinstance(offer.signed, Offer):
            return None
        return offer if offer.signed.lighthouse_fee == lighthouse_fee else None

    def discard(self, offer: TradedOrder) -> None:
        """Stop counting an offer. Unknown ones are ignored."""
        maker, _ = self._offers.pop(offer, (None, False))
        if maker is not None:
            self._makers[maker] -= 1
            if not self._makers[maker]:
                del self._makers[maker]

    def _least(self, maker: str) -> TradedOrder:
        (heaviest, most), *_ = self._makers.most_common(1)
        if most > max(self._makers[maker], 1):
            return next(offer for offer in reversed(self._offers) if self._offers[offer][0] == heaviest)
        for offer, (_, pays) in self._offers.items():
            if not pays:
                return offer
        raise TooManyOffers(maker)
