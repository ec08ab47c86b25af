"""A provider and orders whose validator is a lighthouse."""

from __future__ import annotations

from itertools import count
from typing import TYPE_CHECKING

import pytest

from mesh.base.background import Background
from mesh.chain import XRT
from mesh.market.provider import Provider
from tests.support.waiting import until_found, until_heard

if TYPE_CHECKING:
    from mesh.chain._contracts import ContractKind
    from tests.support.provider.local_market import LocalMarket

_names = count(1)


async def verdicts(provider: Provider) -> dict[tuple[str, str], float]:
    """The received messages by kind and verdict."""
    families = {family.name: family for family in await provider.status.measure()}
    return {
        (sample.labels["kind"], sample.labels["verdict"]): sample.value
        for sample in families["aira_messages_total"].samples
        if sample.value
    }


@pytest.mark.parametrize("contracts", ["mesh", "original"])
async def test_orders_whose_validator_is_a_lighthouse_are_not_matched(
    local: LocalMarket, contracts: ContractKind
) -> None:
    async with local.chain_of("provider") as chain:
        name = f"validators-{next(_names)}"
        trap = (await chain.lighthouses.create(minimal_stake=XRT, timeout_blocks=5, name=name)).lighthouse
    session = await local.new_session()
    async with (
        local.chain_of("provider", kind=contracts, generation=3) as chain,
        Provider(session, chain, local.market) as provider,
        Background() as tasks,
    ):
        tasks.start(provider.run(), "provider at work")
        for kind in ("demand", "offer"):
            await until_heard(local.session, f"aira/{local.market}/{kind}/x")
        demand, offer = local.demand(validator=trap), local.offer(validator=trap)
        local.publish(demand, offer)

        async def are_refused() -> bool:
            return await verdicts(provider) == {("demand", "validator"): 1, ("offer", "validator"): 1}

        await until_found(are_refused, what="the refusals")
        assert len(provider.book) == 0
        assert await local.liabilities_of(demand) == []
