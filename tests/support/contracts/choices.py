"""What Hypothesis chooses from in histories of money: people, providers, agreements and amounts."""

from __future__ import annotations

from functools import cache
from typing import TYPE_CHECKING, Final

from hypothesis import strategies as st

from schemas import ZERO_ADDRESS
from tests.support.contracts.books import UNLIMITED, Terms
from tests.support.contracts.stage import FUNDS, Stage
from tests.support.contracts.suite import XRT

if TYPE_CHECKING:
    from hypothesis.strategies import SearchStrategy

NEXT: Final = "the current provider"

COSTS: Final = st.sampled_from((0, 1, 200_000, 300_000, 5 * XRT, 5 * XRT, 30 * XRT))
FEES: Final = st.sampled_from((0, 0, 1, 2 * XRT, 2 * XRT, 30 * XRT))
STAKES: Final = st.sampled_from((0, 1, XRT, 3 * XRT, FUNDS + 1))
ALLOWANCES: Final = st.sampled_from((0, 300_000, 5 * XRT, UNLIMITED))
MOSTLY: Final = st.sampled_from((True, True, True, False))


@cache
def stage() -> Stage:
    """The contracts, deployed once."""
    return Stage()


def anybody() -> SearchStrategy[str]:
    """One of the people."""
    return st.sampled_from(stage().people)


def party() -> SearchStrategy[str]:
    """One of those who are promisees and promisors."""
    return st.sampled_from(stage().people[:3])


def provider() -> SearchStrategy[str]:
    """An account that may have a stake (the first is sometimes a party); mostly the current provider."""
    return st.sampled_from((NEXT, NEXT, NEXT, NEXT, *stage().people[2:]))


def agreement() -> SearchStrategy[Terms]:
    """What two people, or one, may want to agree on."""
    market = stage()
    first, second, third = market.people[:3]

    def of(generation: int) -> SearchStrategy[Terms]:
        judge = market.judge if generation == 3 else market.jury
        return st.builds(
            Terms,
            generation=st.just(generation),
            token=st.sampled_from((market.xrt, market.xrt, market.foreign)),
            cost=COSTS,
            validator=st.sampled_from((ZERO_ADDRESS, ZERO_ADDRESS, judge)),
            validator_fee=FEES,
            lighthouse_fee=FEES,
            promisee=st.sampled_from((first, first, third)),
            promisor=st.sampled_from((second, second, first, third)),
        )

    return of(5) | of(3)


ANYBODY: Final = st.deferred(anybody)
PARTY: Final = st.deferred(party)
PROVIDER: Final = st.deferred(provider)
AGREEMENT: Final = st.deferred(agreement)
