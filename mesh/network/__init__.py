"""Zenoh: sessions, the channel of verified messages, services."""

from mesh.network.channel import Channel, Subscription, message_key
from mesh.network.pump import Pump
from mesh.network.services import ServiceFailed, Services, call
from mesh.network.session import Endpoints, Network, NetworkChange, free_endpoint
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
]
