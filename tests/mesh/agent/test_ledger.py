"""The ledger: what an agent has done, it remembers."""

from __future__ import annotations

import asyncio
import sqlite3
from typing import TYPE_CHECKING

import pytest
from msgspec.structs import replace

from mesh.agent.ledger import Ledger, Outgoing, Phase
from tests.support.agent.ledgers import RESULT, ledger, path
from tests.support.agent.samples import liability, message
from tests.support.orders import PERSON, ROBOT, STRANGER, demand, offer, withdrawal

if TYPE_CHECKING:
    from pathlib import Path

__all__ = ["ledger", "path"]


async def test_a_new_job_is_incoming_and_holds_the_record(ledger: Ledger) -> None:
    assert await ledger.add_job(liability())
    job = await ledger.job(liability().address)
    assert job is not None
    assert (job.liability, job.phase, job.success, job.result, job.position, job.note) == (
        liability(),
        Phase.INCOMING,
        None,
        None,
        0,
        "",
    )


async def test_the_promisees_of_the_latest_jobs_are_listed(ledger: Ledger) -> None:
    promisees = [signer.address for signer in (PERSON, ROBOT, STRANGER)]
    for number, promisee in enumerate(promisees):
        await ledger.add_job(replace(liability(str(number)), promisee=promisee))
    assert await ledger.promisees(2) == promisees[1:]


async def test_many_names_are_looked_up(ledger: Ledger) -> None:
    await ledger.add_job(liability())
    names = [*map(str, range(40_000)), liability().address]
    assert await ledger.holds(names) == {liability().address}


async def test_unknown_jobs_are_none(ledger: Ledger) -> None:
    assert await ledger.job(liability().address) is None


async def test_adding_a_known_job_changes_nothing(ledger: Ledger) -> None:
    await ledger.add_job(liability())
    await ledger.set_phase(liability().address, Phase.RUNNING, position=7)
    assert not await ledger.add_job(liability())
    job = await ledger.job(liability().address)
    assert job is not None
    assert (job.phase, job.position) == (Phase.RUNNING, 7)


async def test_a_phase_without_position_keeps_the_position(ledger: Ledger) -> None:
    await ledger.add_job(liability())
    await ledger.set_phase(liability().address, Phase.RUNNING, position=7)
    await ledger.set_phase(liability().address, Phase.READY)
    job = await ledger.job(liability().address)
    assert job is not None
    assert (job.phase, job.position) == (Phase.READY, 7)


async def test_a_position_keeps_the_phase(ledger: Ledger) -> None:
    await ledger.add_job(liability())
    await ledger.set_phase(liability().address, Phase.COMPLETE)
    await ledger.set_position(liability().address, 3, recorded=5)
    job = await ledger.job(liability().address)
    assert job is not None
    assert (job.phase, job.position) == (Phase.COMPLETE, 3)


async def test_a_job_set_aside_is_unknown_until_it_is_added_again_with_its_state(ledger: Ledger) -> None:
    await ledger.add_job(liability())
    await ledger.set_phase(liability().address, Phase.RUNNING, position=7)
    await ledger.set_aside(liability().address)
    assert await ledger.job(liability().address) is None
    assert await ledger.jobs() == []
    assert await ledger.add_job(liability())
    assert not await ledger.add_job(liability())
    job = await ledger.job(liability().address)
    assert job is not None
    assert (job.phase, job.position) == (Phase.RUNNING, 7)


async def test_jobs_are_listed_by_phase_oldest_first(ledger: Ledger) -> None:
    for name in ("c", "a", "b", "done"):
        await ledger.add_job(liability(name))
    await ledger.set_phase(liability("done").address, Phase.FINALIZED)
    await ledger.set_phase(liability("a").address, Phase.READY)
    assert [job.liability for job in await ledger.jobs()] == [liability("c"), liability("a"), liability("b")]
    assert [job.liability for job in await ledger.jobs((Phase.READY,))] == [liability("a")]
    assert await ledger.jobs(()) == []


async def test_completing_writes_the_end_and_the_result_to_be_sent(ledger: Ledger) -> None:
    await ledger.add_job(liability())
    await ledger.complete(liability().address, success=False, result=RESULT, note="why", outgoing=message())
    job = await ledger.job(liability().address)
    assert job is not None
    assert (job.phase, job.success, job.result, job.note) == (Phase.COMPLETE, False, RESULT, "why")
    assert await ledger.outbox(head=0) == [message()]


async def test_completing_writes_both_or_neither(ledger: Ledger, path: Path) -> None:
    await ledger.add_job(liability())
    with sqlite3.connect(path) as other:
        other.execute("CREATE TRIGGER full BEFORE INSERT ON outbox BEGIN SELECT RAISE(ABORT, 'disk full'); END")
    other.close()
    with pytest.raises(sqlite3.IntegrityError, match="disk full"):
        await ledger.complete(liability().address, success=True, result=RESULT, note="", outgoing=message())
    job = await ledger.job(liability().address)
    assert job is not None
    assert (job.phase, job.result) == (Phase.INCOMING, None)
    assert await ledger.outbox(head=0) == []


async def test_cancelling_a_completion_leaves_both_or_neither_and_later_writes_stay(path: Path) -> None:
    """Wherever the cancellation strikes: the steps of the transaction go through the ledger's thread one by one."""
    for steps in range(15):
        name = f"job {steps}"
        async with Ledger(path) as ledger:
            await ledger.add_job(liability(name))
            completing = asyncio.create_task(
                ledger.complete(
                    liability(name).address, success=True, result=RESULT, note="", outgoing=message(f"of {name}")
                )
            )
            await asyncio.sleep(steps * 0.0002)
            completing.cancel()
            await asyncio.wait([completing])
            await ledger.set_cursor(steps)
        async with Ledger(path) as ledger:
            job = await ledger.job(liability(name).address)
            assert job is not None
            sent = [waiting.identity for waiting in await ledger.outbox(head=0)]
            assert (job.phase is Phase.COMPLETE) == (f"of {name}" in sent)
            assert (await ledger.cursor())[0] == steps


async def test_concurrent_writes_do_not_end_up_in_each_others_transactions(ledger: Ledger) -> None:
    names = [str(number) for number in range(20)]
    await asyncio.gather(*(ledger.add_job(liability(name)) for name in names))
    await asyncio.gather(
        *(
            ledger.complete(liability(name).address, success=True, result=RESULT, note="", outgoing=message(name))
            for name in names
        ),
        *(ledger.set_cursor(number) for number in range(20)),
    )
    assert len(await ledger.jobs((Phase.COMPLETE,))) == 20
    assert len(await ledger.outbox(head=0)) == 20


async def test_a_message_posted_twice_is_kept_once(ledger: Ledger) -> None:
    await ledger.post(message())
    await ledger.post(message())
    assert await ledger.outbox(head=0) == [message()]


async def test_settling_removes_a_message_and_returns_whether_it_was_there(ledger: Ledger) -> None:
    await ledger.post(message())
    assert await ledger.settle("a message")
    assert not await ledger.settle("a message")
    assert await ledger.outbox(head=0) == []


async def test_messages_go_out_in_their_order_until_their_deadline(ledger: Ledger) -> None:
    await ledger.post(message("late", deadline=11))
    await ledger.post(message("early", deadline=10))
    await ledger.post(message("never", deadline=None))
    assert [waiting.identity for waiting in await ledger.outbox(head=9)] == ["late", "early", "never"]
    assert [waiting.identity for waiting in await ledger.outbox(head=10)] == ["late", "never"]
    assert [waiting.identity for waiting in await ledger.outbox(head=0)] == ["late", "never"], "forgotten for good"


async def test_the_history_of_the_chain_is_kept_with_the_cursor(ledger: Ledger) -> None:
    assert await ledger.cursor() == (None, b"")
    await ledger.set_cursor(41)
    assert await ledger.cursor() == (41, b"")
    await ledger.set_cursor(42, history=b"blocks")
    assert await ledger.cursor() == (42, b"blocks")


async def test_a_spent_order_returns_when_its_contract_is_reverted(ledger: Ledger) -> None:
    one, other = Outgoing.of(demand(deadline=50)), Outgoing.of(demand())
    for order in (one, other):
        await ledger.post(order)
    await ledger.spend(one.identity, "0xA")
    assert await ledger.outbox(head=0) == [other]

    assert (await ledger.spent("0xA"), await ledger.spent("0xB")) == ([one], [])
    await ledger.unspend("0xB")
    assert await ledger.outbox(head=0) == [other]
    await ledger.unspend("0xA")
    assert await ledger.outbox(head=0) == [other, one]
    assert await ledger.spent("0xA") == []
    assert await ledger.outbox(head=50) == [other], "and it has its deadline as before"


async def test_only_the_latest_spent_orders_are_kept(path: Path) -> None:
    orders = [Outgoing.of(demand()) for _ in range(4)]
    async with Ledger(path, spent_kept=2) as ledger:
        for number, order in enumerate(orders):
            await ledger.post(order)
            await ledger.spend(order.identity, f"0x{number}")
        assert [await ledger.spent(f"0x{number}") for number in range(4)] == [[], [], [orders[2]], [orders[3]]]


async def test_an_order_that_is_not_in_the_outbox_is_not_spent(ledger: Ledger) -> None:
    await ledger.spend("an order of before", "0xA")
    assert await ledger.spent("0xA") == []


async def test_a_withdrawn_order_is_replaced_by_its_withdrawal_until_its_deadline(path: Path) -> None:
    signed = demand(deadline=50)
    one, other, withdrawn = Outgoing.of(signed), Outgoing.of(offer(deadline=60)), Outgoing.of(withdrawal(signed))
    async with Ledger(path) as ledger:
        for order in (one, other):
            await ledger.post(order)
        await ledger.withdraw({one.identity: withdrawn})
    async with Ledger(path) as ledger:
        assert await ledger.outbox(head=49) == [other, withdrawn]
        found = [(order.identity, order.is_withdrawn) for order in await ledger.orders()]
        assert found == [(other.identity, False), (one.identity, True)]
        assert await ledger.outbox(head=50) == [other]
        assert [order.identity for order in await ledger.orders()] == [other.identity]


async def test_a_withdrawn_order_that_becomes_a_contract_stays_withdrawn_after_a_reorganisation(ledger: Ledger) -> None:
    signed = demand()
    order, withdrawn = Outgoing.of(signed), Outgoing.of(withdrawal(signed))
    await ledger.post(order)
    await ledger.withdraw({order.identity: withdrawn})
    await ledger.spend(order.identity, "0xA")
    assert await ledger.orders() == []
    assert await ledger.spent("0xA") == [order]
    await ledger.unspend("0xA")
    assert [(stored.identity, stored.is_withdrawn) for stored in await ledger.orders()] == [(order.identity, True)]
    assert await ledger.outbox(head=0) == [withdrawn]


async def test_the_contract_of_a_withdrawn_order_is_listed_like_others(ledger: Ledger) -> None:
    signed, kept = demand(), demand()
    for order in (Outgoing.of(signed), Outgoing.of(kept)):
        await ledger.post(order)
    await ledger.withdraw({Outgoing.of(signed).identity: Outgoing.of(withdrawal(signed))})
    assert await ledger.contracts("demand") == []
    for order, address in ((Outgoing.of(kept), "0x" + "1" * 40), (Outgoing.of(signed), "0x" + "2" * 40)):
        await ledger.spend(order.identity, address)
    assert {address for _, address in await ledger.contracts("demand")} == {"0x" + "1" * 40, "0x" + "2" * 40}


async def test_an_order_withdrawn_on_the_chain_can_not_become_a_contract(ledger: Ledger) -> None:
    signed = demand()
    order, withdrawn = Outgoing.of(signed), Outgoing.of(withdrawal(signed))
    await ledger.post(order)
    await ledger.withdraw({order.identity: withdrawn})
    await ledger.use_up(order.identity, "0x" + "a" * 64)
    assert await ledger.orders() == []
    assert await ledger.contracts("demand") == []


async def test_an_order_is_replaced_at_its_place_in_one_step(ledger: Ledger) -> None:
    old, new = Outgoing.of(demand()), Outgoing.of(demand())
    await ledger.post(old)
    await ledger.replace(old.identity, new)
    assert await ledger.outbox(head=0) == [new]


@pytest.mark.parametrize("is_withdrawn", [False, True], ids=["open", "withdrawn"])
async def test_an_expired_order_is_known_while_a_reorganisation_may_bring_its_contract_back(
    path: Path, *, is_withdrawn: bool
) -> None:
    signed = demand(deadline=50)
    order = Outgoing.of(signed)
    async with Ledger(path, reorg_depth=12) as ledger:
        await ledger.post(order)
        if is_withdrawn:
            await ledger.withdraw({order.identity: Outgoing.of(withdrawal(signed))})
        await ledger.spend(order.identity, "the contract")
        await ledger.unspend("the contract")
        assert await ledger.outbox(head=61) == []
        assert await ledger.waiting_by_kind(head=61) == {}
        await ledger.spend(order.identity, "the contract")
        assert await ledger.contracts("demand") == [(order.payload, "the contract")]

        await ledger.unspend("the contract")
        assert await ledger.outbox(head=62) == []
        await ledger.spend(order.identity, "the contract")
        assert await ledger.contracts("demand") == [], "it is forgotten"
