"""What a provider does while something fails."""

from __future__ import annotations

from typing import TYPE_CHECKING

from tests.support.waiting import until

if TYPE_CHECKING:
    import pytest

    from mesh.market.provider import Provider
    from tests.support.provider.local_market import LocalMarket


async def works_on(local: LocalMarket, provider: Provider) -> bool:
    """Whether the provider creates the contract of two good orders."""
    demand = local.demand()
    local.publish(demand, local.offer())
    await local.liability_of(demand)
    await until(lambda: provider.earnings().created > 0)
    return True


async def until_read(local: LocalMarket, provider: Provider) -> None:
    """Wait until the provider has read the chain up to its latest block."""
    head = await local.chain.block_number()
    await until(lambda: provider.head.head >= head)


def outages(caplog: pytest.LogCaptureFixture, name: str) -> list[str]:
    """The codes of the errors with which outages of `name` began."""
    return [record.facts["code"] for record in events(caplog, f"{name}-outage")]  # type: ignore[attr-defined]


def events(caplog: pytest.LogCaptureFixture, name: str) -> list[object]:
    """The logged events of that name."""
    return [record for record in caplog.records if getattr(record, "event", "") == name]
