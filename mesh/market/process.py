"""A process with providers, one or one for each lighthouse: its figures and its health, for who runs it."""

from __future__ import annotations

from typing import TYPE_CHECKING

from mesh.chain.metrics import ChainMetrics
from mesh.network.metrics import link_state, network_families

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from mesh.chain import Chain
    from mesh.market.provider import Provider
    from mesh.network import Network
    from mesh.telemetry.metrics import MetricFamily


class ProviderProcess:
    """The `providers` of one account on `chain`, in `network`; all are open."""

    def __init__(self, network: Network, chain: Chain, providers: Sequence[Provider]) -> None:
        self._network = network
        self._chain = ChainMetrics(chain)
        self._providers = providers

    async def measure(self) -> tuple[MetricFamily, ...]:
        """The figures of session, chain and account, and those of each provider with its lighthouse."""
        families = [*network_families(self._network), *await self._chain.measure()]
        for provider in self._providers:
            families += await provider.measure()
        return tuple(families)

    def health(self) -> Mapping[str, str]:
        """The state of each part; where there are several providers, their parts name the lighthouse."""
        parts = {"channel": link_state(self._network)}
        for provider in self._providers:
            of = f" of {provider.channel.lighthouse}" if len(self._providers) > 1 else ""
            parts |= {f"{part}{of}": state for part, state in provider.health().items()}
        return parts
