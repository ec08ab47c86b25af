"""Zenoh: sessions, the channel of verified messages, presence, services."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from schemas.loading import on_demand

if TYPE_CHECKING:
    from mesh.network.channel import Channel, Subscription
    from mesh.network.connecting import NotAdmitted
    from mesh.network.endpoints import Endpoints, free_endpoint
    from mesh.network.pump import Pump
    from mesh.network.services import ServiceFailed, Services, call
    from mesh.network.session import Network, NetworkChange
    from mesh.network.tls import Tls
    from mesh.network.validation import MessageValidator, ValidationStatistics, message_key

_HOMES: Final = {
    "Channel": "mesh.network.channel",
    "MessageValidator": "mesh.network.validation",
    "Endpoints": "mesh.network.endpoints",
    "Network": "mesh.network.session",
    "NetworkChange": "mesh.network.session",
    "NotAdmitted": "mesh.network.connecting",
    "Pump": "mesh.network.pump",
    "ServiceFailed": "mesh.network.services",
    "Services": "mesh.network.services",
    "Subscription": "mesh.network.channel",
    "Tls": "mesh.network.tls",
    "ValidationStatistics": "mesh.network.validation",
    "call": "mesh.network.services",
    "free_endpoint": "mesh.network.endpoints",
    "message_key": "mesh.network.validation",
}

# Names load on first use: an edge process opens a session without asyncio.
__getattr__ = on_demand(__name__, _HOMES)

__all__ = [
    "Channel",
    "Endpoints",
    "MessageValidator",
    "Network",
    "NetworkChange",
    "NotAdmitted",
    "Pump",
    "ServiceFailed",
    "Services",
    "Subscription",
    "Tls",
    "ValidationStatistics",
    "call",
    "free_endpoint",
    "message_key",
]
