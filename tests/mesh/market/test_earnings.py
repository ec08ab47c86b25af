"""A provider's account: what was earned, what was spent, what the chain took back."""

from __future__ import annotations

from mesh.chain import Created, Reverted, Settled
from mesh.market import earnings
from mesh.market.earnings import REASONS, Earnings, EarningsLedger

ADDRESS = "0x19437Cb65760805A0e55339186F03B2d980eBBf9"
OTHER = "0x27023154114b066515Ae678cb06E19417B8fcA73"
NOTHING = Earnings(created=0, finalized=0, rejected={}, gas_used=0, spent=0, fees=0, minted=0)


def created(address: str = ADDRESS) -> Created:
    return Created(address, "0xabc", gas_used=150_000, wei=3 * 10**14)


def settled() -> Settled:
    return Settled("0xdef", gas_used=100_000, wei=2 * 10**14, minted=42_000)


def test_a_whole_job_is_summed_up() -> None:
    books = EarningsLedger()
    books.made(created(), fee=5)
    books.ended(ADDRESS, settled())
    assert books.earnings() == Earnings(
        created=1, finalized=1, rejected={}, gas_used=250_000, spent=5 * 10**14, fees=5, minted=42_000
    )


def test_what_failed_is_paid_for_if_it_was_mined() -> None:
    books = EarningsLedger()
    books.failed(Reverted("NotYourTurn"))
    assert books.earnings() == NOTHING
    books.failed(Reverted("NotYourTurn", gas_used=30_000, wei=7))
    assert (books.earnings().gas_used, books.earnings().spent) == (30_000, 7)


def test_what_the_chain_takes_back_is_struck_out() -> None:
    books = EarningsLedger()
    books.made(created(), fee=5)
    books.made(created(OTHER), fee=1)
    books.ended(ADDRESS, settled())
    books.unended(ADDRESS)
    books.unmade(ADDRESS)
    books.unmade(ADDRESS)
    assert books.earnings() == Earnings(
        created=1, finalized=0, rejected={}, gas_used=150_000, spent=3 * 10**14, fees=1, minted=0
    )


def test_what_others_made_is_not_struck_out() -> None:
    books = EarningsLedger()
    books.unmade(ADDRESS)
    books.unended(ADDRESS)
    assert books.earnings() == NOTHING


def test_rejections_are_counted_by_reason() -> None:
    books = EarningsLedger()
    for reason in ("full", "expired", "full"):
        books.rejected(reason)
    assert books.earnings().rejected == {"full": 2, "expired": 1}


def test_the_account_is_one_line() -> None:
    books = EarningsLedger()
    books.made(created(), fee=2 * 10**9)
    books.ended(ADDRESS, settled())
    books.rejected("full")
    assert str(books.earnings()) == (
        "contracts: 1 made, 1 finalized; messages rejected: 1; "
        "earned 2.000042 XRT (2 in fees, 0.000042 minted for gas), spent 0.0005 ETH on 250,000 gas"
    )


def test_what_was_entered_only_grows_and_what_was_taken_back_is_apart() -> None:
    books = EarningsLedger()
    books.matched()
    books.made(created(), fee=5)
    books.ended(ADDRESS, settled())
    books.unended(ADDRESS)
    books.unmade(ADDRESS)
    books.made(created(), fee=5)
    seen = books.turnover()
    assert seen.matches == 1
    assert (seen.entered.created, seen.entered.finalized, seen.entered.fees) == (2, 1, 10)
    assert (seen.taken_back.created, seen.taken_back.finalized, seen.taken_back.fees) == (1, 1, 5)
    assert books.earnings().created == 1


def test_reasons_that_strangers_make_up_are_told_apart_up_to_a_bound() -> None:
    books = EarningsLedger()
    books.rejected("DeadlineReached")
    for number in range(1000):
        books.rejected(f"MadeUp{number}")
    books.rejected("DeadlineReached")
    rejected = books.earnings().rejected
    assert len(rejected) == REASONS + 1
    assert rejected["DeadlineReached"] == 2
    assert rejected[earnings.OTHER] == 1000 - (REASONS - 1)
