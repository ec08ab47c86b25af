"""Zenoh: sessions, the channel of verified messages, services."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from schemas.loading import on_demand

if TYPE_CHECKING:
    from mesh.network.addressing import message_key, verified_key
    from mesh.network.channel import Channel
    from mesh.network.endpoints import Endpoints, free_endpoint
    from mesh.network.errors import NotAdmitted
    from mesh.network.pump import Pump
    from mesh.network.services import ServiceFailed, Services, call
    from mesh.network.session import Network, NetworkChange
    from mesh.network.subscription import Subscription
    from mesh.network.tls import Tls
    from mesh.network.validation import MessageValidator, Statistics

_HOMES: Final = {
    "Channel": "mesh.network.channel",
    "MessageValidator": "mesh.network.validation",
    "Endpoints": "mesh.network.endpoints",
    "Network": "mesh.network.session",
    "NetworkChange": "mesh.network.session",
    "NotAdmitted": "mesh.network.errors",
    "Pump": "mesh.network.pump",
    "ServiceFailed": "mesh.network.services",
    "Services": "mesh.network.services",
    "Statistics": "mesh.network.validation",
    "Subscription": "mesh.network.subscription",
    "Tls": "mesh.network.tls",
    "call": "mesh.network.services",
    "free_endpoint": "mesh.network.endpoints",
    "message_key": "mesh.network.addressing",
    "verified_key": "mesh.network.addressing",
}

# An edge agent opens a session and needs no event loop for it.
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
    "Statistics",
    "Subscription",
    "Tls",
    "call",
    "free_endpoint",
    "message_key",
    "verified_key",
]
