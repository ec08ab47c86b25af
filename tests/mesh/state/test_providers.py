"""What a provider keeps, in backups."""

from __future__ import annotations

import shutil
from typing import TYPE_CHECKING

import pytest

from mesh.composition import provider_files
from mesh.market.sent_orders import SentOrder, SentOrders
from mesh.market.withdrawals import Withdrawals, withdrawn_id
from mesh.state import ContentScope, StateInUse, back_up, examine_archive, restore, take_inventory
from mesh.state.restoring import ExistingState
from schemas import cid_of_bytes
from schemas.signing import verify_message
from tests.support.orders import PERSON, demand, withdrawal
from tests.support.waiting import until

if TYPE_CHECKING:
    from mesh.composition import ProviderFiles
    from tests.support.market import Place

OBJECTIVE = cid_of_bytes(b"nobody's objective")
SENT = SentOrder(b"\1" * 52, "lasting", PERSON.address, 9)


async def files_at(place: Place) -> ProviderFiles:
    settings, lighthouse = place.settings("provider"), place.market.deployment.lighthouse_name
    return await provider_files(settings, place.chains["provider"], place.address("provider"), lighthouse)


async def test_a_running_providers_withdrawals_are_kept_through_a_restore(place: Place) -> None:
    disk, archive, files = place.folder / "provider", place.folder / "backup", await files_at(place)
    async with place.agent("person") as person:
        async with place.provider(**files) as provider:
            order = await (await person.order(OBJECTIVE, cost=300)).withdraw()
            await until(lambda: len(provider.withdrawals) == 1, what="the withdrawal")
            await back_up(disk, archive, content=ContentScope.NEEDED)
        (account,) = (await take_inventory(disk)).accounts
        assert [chain.provides for chain in account.chains] == [(place.market.deployment.lighthouse_name,)]
    assert examine_archive(archive).files == {"sent orders": 1, "withdrawals": 1}
    shutil.rmtree(disk)
    await restore(archive, disk)
    async with place.provider(**files) as provider:
        assert [withdrawal.message.order for withdrawal in provider.withdrawals] == [order.hash]


async def test_a_providers_sent_orders_are_kept_through_a_restore(place: Place) -> None:
    disk, archive, files = place.folder / "provider", place.folder / "backup", await files_at(place)
    async with SentOrders(files["sent_orders"]) as sent:
        await sent.add([SENT])
        await back_up(disk, archive, content=ContentScope.NONE)
    await restore(archive, disk, existing=ExistingState.SET_ASIDE)
    async with SentOrders(files["sent_orders"]) as sent:
        assert sent.left == (SENT,)


async def test_what_a_running_provider_keeps_is_not_replaced(place: Place) -> None:
    disk, archive, files = place.folder / "provider", place.folder / "backup", await files_at(place)
    late = verify_message(withdrawal(demand()))
    with Withdrawals(files["withdrawals"]) as withdrawals:
        await back_up(disk, archive, content=ContentScope.NONE)
        assert withdrawals.add(late)
        with pytest.raises(StateInUse):
            await restore(archive, disk, existing=ExistingState.SET_ASIDE)
    with Withdrawals(files["withdrawals"]) as withdrawals:
        assert withdrawn_id(late) in withdrawals
