"""Zenoh: sessions, the channel of verified messages, presence, services."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from schemas.loading import on_demand

if TYPE_CHECKING:
    from mesh.network.channel import Channel
    from mesh.network.connecting import NotAdmitted
    from mesh.network.endpoints import Endpoints, free_endpoint
    from mesh.network.presence import PresentAgents
    from mesh.network.pump import Pump
    from mesh.network.readings import Reading, ReadingSubscription
    from mesh.network.services import ServiceFailed, Services, call
    from mesh.network.session import Network, NetworkChange
    from mesh.network.subscription import Subscription
    from mesh.network.tls import Tls
    from mesh.network.validation import MessageValidator, ValidationStatistics, message_key

_NAMES: Final = {
    "mesh.network.channel": "Channel",
    "mesh.network.connecting": "NotAdmitted",
    "mesh.network.endpoints": "Endpoints free_endpoint",
    "mesh.network.presence": "PresentAgents",
    "mesh.network.pump": "Pump",
    "mesh.network.readings": "Reading ReadingSubscription",
    "mesh.network.services": "ServiceFailed Services call",
    "mesh.network.session": "Network NetworkChange",
    "mesh.network.subscription": "Subscription",
    "mesh.network.tls": "Tls",
    "mesh.network.validation": "MessageValidator ValidationStatistics message_key",
}

# Names load on first use: an edge process opens a session without asyncio.
__getattr__ = on_demand(__name__, _NAMES)
