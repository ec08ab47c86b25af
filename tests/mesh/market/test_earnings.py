"""What a provider earned and spent, and what a reorganisation reverted."""

from __future__ import annotations

from mesh.chain import Created, Reverted, Settled
from mesh.market import _earnings
from mesh.market._earnings import REASONS, Earnings, EarningsLedger

ADDRESS = "0x19437Cb65760805A0e55339186F03B2d980eBBf9"
CREATION, OTHER_CREATION, FINALIZATION = "0xabc", "0xbca", "0xdef"
NOTHING = Earnings(created=0, finalized=0, rejected={}, gas_used=0, spent=0, fees=0, minted=0)


def created(tx: str = CREATION) -> Created:
    return Created(ADDRESS, tx, nonce=0, gas_used=150_000, wei=3 * 10**14)


def settled() -> Settled:
    return Settled(FINALIZATION, gas_used=100_000, wei=2 * 10**14, minted=42_000)


def test_earnings_of_a_whole_job() -> None:
    ledger = EarningsLedger()
    ledger.created(created(), fee=5)
    ledger.finalized(settled())
    assert ledger.earnings() == Earnings(
        created=1, finalized=1, rejected={}, gas_used=250_000, spent=5 * 10**14, fees=5, minted=42_000
    )


def test_a_failed_transaction_costs_gas_if_it_was_mined() -> None:
    ledger = EarningsLedger()
    ledger.failed(Reverted("NotYourTurn"))
    assert ledger.earnings() == NOTHING
    ledger.failed(Reverted("NotYourTurn", gas_used=30_000, wei=7))
    assert (ledger.earnings().gas_used, ledger.earnings().spent) == (30_000, 7)


def test_a_reorganisation_subtracts_reverted_earnings() -> None:
    ledger = EarningsLedger()
    ledger.created(created(), fee=5)
    ledger.created(created(OTHER_CREATION), fee=1)
    ledger.finalized(settled())
    ledger.reverted(FINALIZATION)
    ledger.reverted(CREATION)
    ledger.reverted(CREATION)
    assert ledger.earnings() == Earnings(
        created=1, finalized=0, rejected={}, gas_used=150_000, spent=3 * 10**14, fees=1, minted=0
    )


def test_a_reorganisation_does_not_subtract_earnings_of_others() -> None:
    ledger = EarningsLedger()
    ledger.reverted(CREATION)
    ledger.reverted(FINALIZATION)
    assert ledger.earnings() == NOTHING


def test_a_reverted_transaction_that_is_mined_again_counts_again() -> None:
    ledger = EarningsLedger()
    ledger.created(created(), fee=5)
    ledger.mined(CREATION)
    ledger.reverted(CREATION)
    assert ledger.earnings() == NOTHING
    ledger.mined(CREATION)
    ledger.mined(CREATION)
    ledger.mined(OTHER_CREATION)
    assert (ledger.earnings().created, ledger.earnings().fees) == (1, 5)


def test_rejections_are_counted_by_reason() -> None:
    ledger = EarningsLedger()
    for reason in ("full", "expired", "full"):
        ledger.rejected(reason)
    assert ledger.earnings().rejected == {"full": 2, "expired": 1}


def test_earnings_as_text_are_one_line() -> None:
    ledger = EarningsLedger()
    ledger.created(created(), fee=2 * 10**9)
    ledger.finalized(settled())
    ledger.rejected("full")
    assert str(ledger.earnings()) == (
        "contracts: 1 made, 1 finalized; messages rejected: 1; "
        "earned 2.000042 XRT (2 in fees, 0.000042 minted for gas), spent 0.0005 ETH on 250,000 gas"
    )


def test_turnover_only_grows_and_counts_reverted_entries_separately() -> None:
    ledger = EarningsLedger()
    ledger.matched()
    ledger.created(created(), fee=5)
    ledger.finalized(settled())
    ledger.reverted(FINALIZATION)
    ledger.reverted(CREATION)
    ledger.created(created(), fee=5)
    seen = ledger.turnover()
    assert seen.matches == 1
    assert (seen.entered.created, seen.entered.finalized, seen.entered.fees) == (2, 1, 10)
    assert (seen.reverted.created, seen.reverted.finalized, seen.reverted.fees) == (1, 1, 5)
    assert ledger.earnings().created == 1


def test_a_limited_number_of_reasons_is_counted_separately() -> None:
    ledger = EarningsLedger()
    ledger.rejected("DeadlineReached")
    for number in range(1000):
        ledger.rejected(f"MadeUp{number}")
    ledger.rejected("DeadlineReached")
    rejected = ledger.earnings().rejected
    assert len(rejected) == REASONS + 1
    assert rejected["DeadlineReached"] == 2
    assert rejected[_earnings.OTHER] == 1000 - (REASONS - 1)
