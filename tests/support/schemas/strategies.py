"""Hypothesis strategies for what travels."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from hypothesis import strategies as st

from schemas import (
    MAX_UINT256,
    Demand,
    Message,
    Offer,
    OrderFeedback,
    Permit,
    Result,
    TransactionFeedback,
    Withdrawal,
    checksum_address,
    cid_of_digest,
)
from schemas.messages import MESSAGE_TYPES

if TYPE_CHECKING:
    from hypothesis.strategies import SearchStrategy

addresses = st.binary(min_size=20, max_size=20).map(checksum_address)
labels = st.text("abcdefghijklmnopqrstuvwxyz0123456789-_", min_size=1, max_size=12)
names = st.builds(
    lambda parts, top: ".".join((*parts, top)),
    st.lists(labels, min_size=1, max_size=4),
    st.sampled_from(("eth", "sid", "test")),
)
parties = addresses | names
cids = st.binary(min_size=32, max_size=32).map(cid_of_digest)
hashes = st.binary(min_size=32, max_size=32).map(bytes.hex)
signatures = st.binary(min_size=65, max_size=65).map(bytes.hex)
amounts = st.integers(0, MAX_UINT256) | st.sampled_from((0, 2**53 + 1, 2**64 - 1, 2**64, MAX_UINT256))


def _order(kind: type[Demand] | type[Offer], party: SearchStrategy[str], generation: int) -> SearchStrategy[Any]:
    fee = "validator_fee" if kind is Demand else "lighthouse_fee"
    fields: dict[str, SearchStrategy[Any]] = {
        "model": cids,
        "objective": cids,
        "token": party,
        "cost": amounts,
        "deadline": amounts,
        "nonce": hashes if generation == 3 else amounts,
        "sender": st.none() if generation == 3 else party,
        "signature": signatures,
        fee: amounts,
    }
    return st.builds(
        lambda parties, **terms: kind(lighthouse=parties[0], validator=parties[1], **terms),
        st.tuples(party, party).filter(lambda parties: parties[0] != parties[1]),
        **fields,
    )


def orders(party: SearchStrategy[str] = parties) -> SearchStrategy[Demand | Offer]:
    """Demands and offers of both generations, with some signature. No lighthouse is its own validator."""
    return st.one_of(*(_order(kind, party, generation) for kind in (Demand, Offer) for generation in (3, 5)))


def results(party: SearchStrategy[str] = parties) -> SearchStrategy[Result]:
    """Results, with some signature."""
    return st.builds(Result, liability=party, result=cids, success=st.booleans(), signature=signatures)


def withdrawals(party: SearchStrategy[str] = parties) -> SearchStrategy[Withdrawal]:
    """Withdrawals, with some signature."""
    return st.builds(Withdrawal, order=hashes, lighthouse=party, deadline=amounts, signature=signatures)


OTHERS: dict[type[Message], SearchStrategy[Any]] = {
    Result: results(),
    Withdrawal: withdrawals(),
    Permit: st.builds(
        Permit,
        owner=addresses,
        spender=addresses,
        token=addresses,
        value=amounts,
        nonce=amounts,
        deadline=amounts,
        domain=hashes,
        signature=signatures,
    ),
    OrderFeedback: st.builds(OrderFeedback, order=hashes, accepted=amounts, signature=signatures),
    TransactionFeedback: st.builds(TransactionFeedback, tx=hashes),
}
"""Messages that are not orders, by kind, with some signature."""


def messages() -> SearchStrategy[Message]:
    """Messages of every kind, with some signature."""
    return st.one_of(orders(), *(OTHERS[kind] for kind in MESSAGE_TYPES if kind not in (Demand, Offer)))
