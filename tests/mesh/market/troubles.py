"""How a provider in trouble is seen to work on."""

from __future__ import annotations

from typing import TYPE_CHECKING

from tests.support.waiting import until

if TYPE_CHECKING:
    from mesh.market.provider import Provider
    from tests.mesh.market.floor import Floor


async def works_on(floor: Floor, provider: Provider) -> bool:
    """Whether the provider makes the contracts of those who mean well."""
    demand = floor.demand()
    floor.publish(demand, floor.offer())
    await floor.liability_of(demand)
    await until(lambda: provider.earnings().created > 0)
    return True
