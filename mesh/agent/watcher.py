"""The figures and the health of an agent without an account: it hears the market, and does nothing in it."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from mesh.network.metrics import link_state, message_families, network_families
from mesh.telemetry.metrics import labelled

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from mesh.network import Channel, Network, Subscription
    from mesh.telemetry.metrics import MetricFamily


class Watcher:
    """One that hears `channel` over `network`."""

    def __init__(self, network: Network, channel: Channel) -> None:
        self._network = network
        self._channel = channel

    async def measure(self, subscriptions: Sequence[Subscription[Any]]) -> tuple[MetricFamily, ...]:
        """The figures of what it hears over `subscriptions`."""
        heard = labelled(message_families(subscriptions), lighthouse=self._channel.lighthouse)
        return (*heard, *network_families(self._network))

    def health(self) -> Mapping[str, str]:
        """Whether it is in the network, which is all that it needs."""
        return {"channel": link_state(self._network)}
