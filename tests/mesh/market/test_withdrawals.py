"""Withdrawals as a provider keeps them."""

from __future__ import annotations

import errno
import os
import secrets
import sqlite3
import stat
from typing import TYPE_CHECKING

from mesh.base.flood import Rate
from mesh.market import order_id
from mesh.market.store import MarketStore, WithdrawalLimits, Withdrawals, withdrawn_id
from schemas import Signer, Withdrawal, verify_message
from tests.support.log_events import logged_facts
from tests.support.orders import LIGHTHOUSE, PERSON, STRANGER, verified_demand

if TYPE_CHECKING:
    from pathlib import Path

    import pytest

    from schemas import Demand, Offer, Verified

FAR = 2**256 - 1


def withdrawal(
    order: Verified[Demand | Offer] | None = None, *, signer: Signer = PERSON, deadline: int = 100
) -> Verified[Withdrawal]:
    digest = (order or verified_demand(deadline=deadline)).hash.hex()
    return verify_message(signer.sign(Withdrawal(order=digest, lighthouse=LIGHTHOUSE, deadline=deadline)))


def test_a_withdrawal_concerns_the_order_of_its_own_signer_only() -> None:
    with Withdrawals() as withdrawals:
        order = verified_demand()
        assert withdrawals.add(withdrawal(order, signer=STRANGER))
        assert order_id(order) not in withdrawals
        assert withdrawals.add(withdrawal(order))
        assert order_id(order) in withdrawals
        assert len(withdrawals) == 2


def test_withdrawals_are_kept_until_their_deadline_also_across_restarts(tmp_path: Path) -> None:
    path = tmp_path / "folder" / "withdrawals.sqlite"
    early, late, far = withdrawal(deadline=10), withdrawal(deadline=11), withdrawal(deadline=FAR)
    with Withdrawals(MarketStore(path)) as withdrawals:
        for one in (far, late, early, late):
            assert withdrawals.add(one)
        assert stat.S_IMODE(path.stat().st_mode) == 0o600
        withdrawals.expire(9)
        assert len(withdrawals) == 3
    with Withdrawals(MarketStore(path)) as withdrawals:
        assert set(withdrawals) == {early, late, far}
        withdrawals.expire(10)
        assert set(withdrawals) == {late, far}
    with Withdrawals(MarketStore(path)) as withdrawals:
        assert set(withdrawals) == {late, far}


def test_a_signer_can_have_a_limited_number() -> None:
    with Withdrawals(limits=WithdrawalLimits(of_signer=2)) as withdrawals:
        assert [withdrawals.add(withdrawal(deadline=deadline)) for deadline in (10, 11, 12)] == [True, True, False]
        assert withdrawals.add(withdrawal(signer=STRANGER))
        withdrawals.expire(10)
        assert withdrawals.add(withdrawal(deadline=13))


def test_a_flood_of_withdrawals_is_refused_but_for_open_orders() -> None:
    with Withdrawals(limits=WithdrawalLimits(rate=Rate(per_second=0.0, burst=2))) as withdrawals:
        made = [withdrawal(signer=Signer(secrets.token_bytes(32))) for _ in range(3)]
        assert [withdrawals.add(one) for one in made] == [True, True, False]
        assert withdrawals.add(made[2], is_open=True)
        assert withdrawals.add(made[0]), "it is known"


def test_when_there_are_too_many_those_with_the_latest_deadline_are_forgotten() -> None:
    with Withdrawals(limits=WithdrawalLimits(kept=2), deadline_limit=FAR) as withdrawals:
        first, never, soon = (withdrawal(deadline=deadline) for deadline in (FAR, FAR, 20))
        assert [withdrawals.add(one) for one in (first, never, soon)] == [True, True, True]
        assert set(withdrawals) == {first, soon}
        assert not withdrawals.add(never)
        assert [withdrawn_id(one) in withdrawals for one in (first, never, soon)] == [True, False, True]


async def test_a_flood_of_withdrawals_that_end_late_leaves_places_for_those_that_end_soon() -> None:
    with Withdrawals(limits=WithdrawalLimits(kept=8), deadline_limit=100) as withdrawals:
        withdrawals.expire(50)
        far, soon = ([withdrawal(deadline=deadline) for _ in range(3)] for deadline in (151, 150))
        assert all(withdrawals.add(one) for one in (*far, *soon))
        await withdrawals.sync()
        assert [withdrawals.is_kept(withdrawn_id(one)) for one in far] == [True, True, False]
        assert [withdrawals.is_kept(withdrawn_id(one)) for one in soon] == [True, True, False]


async def test_what_a_power_failure_may_take_back_is_not_promised(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    path, one, synced = tmp_path / "withdrawals.sqlite", withdrawal(), list[str]()
    fsync = os.fsync

    def noted(descriptor: int) -> None:
        synced.append(os.readlink(f"/proc/self/fd/{descriptor}"))
        fsync(descriptor)

    def failed(descriptor: int) -> None:
        raise OSError(errno.EIO, "the disk is broken")

    with Withdrawals(MarketStore(path)) as withdrawals:
        assert withdrawals.add(one)
        assert not withdrawals.is_kept(withdrawn_id(one))
        monkeypatch.setattr(os, "fsync", failed)
        await withdrawals.sync()
        assert not withdrawals.is_kept(withdrawn_id(one))
        assert logged_facts(caplog, "withdrawals-outage")
        monkeypatch.setattr(os, "fsync", noted)
        await withdrawals.sync()
        assert withdrawals.is_kept(withdrawn_id(one))
        assert synced == [f"{path}-wal"]
    with Withdrawals(MarketStore(path)) as withdrawals:
        assert withdrawals.is_kept(withdrawn_id(one))
        assert synced[1:] == [f"{path}-wal", str(tmp_path)], "an earlier process may have been killed before it did"


def test_a_withdrawal_that_can_not_be_read_takes_no_others_along(tmp_path: Path) -> None:
    path, one = tmp_path / "withdrawals.sqlite", withdrawal()
    with Withdrawals(MarketStore(path)) as withdrawals:
        withdrawals.add(one)
    with sqlite3.connect(path) as database:
        database.execute("INSERT INTO withdrawals VALUES (x'00', '', x'00', 1)")
    database.close()
    with Withdrawals(MarketStore(path)) as withdrawals:
        assert set(withdrawals) == {one}


async def test_a_flood_of_withdrawals_that_end_sooner_makes_no_other_forgotten_that_was_promised(
    tmp_path: Path,
) -> None:
    path, flood = tmp_path / "withdrawals.sqlite", [withdrawal(deadline=9) for _ in range(9)]
    with Withdrawals(MarketStore(path), limits=WithdrawalLimits(kept=4)) as withdrawals:
        assert sum(withdrawals.add(one) for one in flood) >= 4
        await withdrawals.sync()
        kept = [withdrawals.is_kept(withdrawn_id(one)) for one in flood]
        assert kept == [True] * 2 + [False] * 7, "half of the places"
        assert len(withdrawals) == 4
        assert withdrawals.add(honest := withdrawal(deadline=20), is_open=True)
        assert withdrawals.add(withdrawal(deadline=20), is_open=True)
        await withdrawals.sync()
        assert withdrawals.is_kept(withdrawn_id(honest))

        assert not any(withdrawals.add(withdrawal(deadline=8)) for _ in range(9))
        assert not withdrawals.add(withdrawal(deadline=7), is_open=True), "refused, for all others were promised"
        assert honest in set(withdrawals)
        assert len(withdrawals) == 4
    with Withdrawals(MarketStore(path), limits=WithdrawalLimits(kept=4)) as withdrawals:
        assert not withdrawals.add(withdrawal(deadline=7))
        await withdrawals.sync()
        assert withdrawals.is_kept(withdrawn_id(honest))
        withdrawals.expire(9)
        assert len(withdrawals) == 2
        assert withdrawals.add(withdrawal(deadline=7), is_open=True)


def test_withdrawals_are_known_without_a_disk(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    path = tmp_path / "withdrawals.sqlite"
    path.write_bytes(b"not a database, however you look at it" * 100)
    with Withdrawals(MarketStore(path)) as withdrawals:
        assert withdrawals.add(one := withdrawal())
        assert withdrawn_id(one) in withdrawals
        assert not withdrawals.is_kept(withdrawn_id(one))
        withdrawals.expire(100)
        assert len(withdrawals) == 0
    (outage,) = logged_facts(caplog, "withdrawals-outage")
    assert outage["code"] == "withdrawals-not-kept"


async def test_a_withdrawal_that_could_not_be_written_is_written_with_its_next_copy(tmp_path: Path) -> None:
    path, one = tmp_path / "withdrawals.sqlite", withdrawal()
    with Withdrawals(MarketStore(path)) as withdrawals:
        with sqlite3.connect(path, isolation_level=None) as other:
            other.execute("BEGIN IMMEDIATE")  # nobody else can write
            assert withdrawals.add(one)
            await withdrawals.sync()
            assert not withdrawals.is_kept(withdrawn_id(one))
            other.execute("ROLLBACK")
        other.close()
        assert withdrawals.add(one)
        await withdrawals.sync()
        assert withdrawals.is_kept(withdrawn_id(one))
    with Withdrawals(MarketStore(path)) as again:
        await again.sync()
        assert again.is_kept(withdrawn_id(one))
