"""What a provider keeps, in backups."""

from __future__ import annotations

import shutil
from typing import TYPE_CHECKING

from mesh.errors import ConfigurationError
from mesh.market._orders import SentOrder
from mesh.market.provider import provider_file
from mesh.market.store import MarketStore, Withdrawals, withdrawn_id
from mesh.ops.state import back_up, examine_archive, restore, take_inventory
from schemas import cid_of_bytes
from schemas.signing import verify_message
from tests.support.orders import PERSON, demand, withdrawal
from tests.support.raising import raises_with
from tests.support.waiting import until

if TYPE_CHECKING:
    from pathlib import Path

    from tests.support.market import Place

OBJECTIVE = cid_of_bytes(b"nobody's objective")
SENT = SentOrder(b"\1" * 52, "lasting", PERSON.address, 9)


async def file_of(place: Place) -> Path:
    settings, lighthouse = place.settings("provider"), place.market.deployment.lighthouse_name
    return await provider_file(settings, place.chains["provider"], place.address("provider"), lighthouse)


async def test_a_running_providers_withdrawals_are_kept_through_a_restore(place: Place) -> None:
    disk, archive, path = place.folder / "provider", place.folder / "backup", await file_of(place)
    async with place.agent("person") as person:
        async with place.provider(store=path) as provider:
            order = await (await person.order(OBJECTIVE, cost=300)).withdraw()
            await until(lambda: len(provider.withdrawals) == 1, what="the withdrawal")
            await back_up(disk, archive, content="needed")
        (account,) = (await take_inventory(disk)).accounts
        assert [chain.provides for chain in account.chains] == [(place.market.deployment.lighthouse_name,)]
    assert examine_archive(archive).files == {"providers": 1}
    shutil.rmtree(disk)
    await restore(archive, disk)
    async with place.provider(store=path) as provider:
        assert [withdrawal.message.order for withdrawal in provider.withdrawals] == [order.hash]


async def test_a_providers_sent_orders_are_kept_through_a_restore(place: Place) -> None:
    disk, archive, path = place.folder / "provider", place.folder / "backup", await file_of(place)
    with MarketStore(path) as store:
        await store.keep_sent([SENT])
        await back_up(disk, archive, content="none")
    await restore(archive, disk, set_aside=True)
    with MarketStore(path) as store:
        assert store.sent_orders() == [SENT]


async def test_what_a_running_provider_keeps_is_not_replaced(place: Place) -> None:
    disk, archive, path = place.folder / "provider", place.folder / "backup", await file_of(place)
    late = verify_message(withdrawal(demand()))
    with Withdrawals(MarketStore(path)) as withdrawals:
        await back_up(disk, archive, content="none")
        assert withdrawals.add(late)
        with raises_with(ConfigurationError, code="state-in-use"):
            await restore(archive, disk, set_aside=True)
    with Withdrawals(MarketStore(path)) as withdrawals:
        assert withdrawn_id(late) in withdrawals
