"""Zenoh: sessions, the channel of verified messages, services."""

from mesh.network.addressing import message_key, verified_key
from mesh.network.channel import Channel
from mesh.network.endpoints import Endpoints, free_endpoint
from mesh.network.pump import Pump
from mesh.network.services import ServiceFailed, Services, call
from mesh.network.session import Network, NetworkChange
from mesh.network.subscription import Subscription
from mesh.network.verification import Door, Statistics

__all__ = [
    "Channel",
    "Door",
    "Endpoints",
    "Network",
    "NetworkChange",
    "Pump",
    "ServiceFailed",
    "Services",
    "Statistics",
    "Subscription",
    "call",
    "free_endpoint",
    "message_key",
    "verified_key",
]
