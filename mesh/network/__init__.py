"""Zenoh: sessions, the channel of verified messages, services."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

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
    from mesh.network.verification import Door, Statistics

_HOMES: Final = {
    "Channel": "channel",
    "Door": "verification",
    "Endpoints": "endpoints",
    "Network": "session",
    "NetworkChange": "session",
    "NotAdmitted": "errors",
    "Pump": "pump",
    "ServiceFailed": "services",
    "Services": "services",
    "Statistics": "verification",
    "Subscription": "subscription",
    "Tls": "tls",
    "call": "services",
    "free_endpoint": "endpoints",
    "message_key": "addressing",
    "verified_key": "addressing",
}


def __getattr__(name: str) -> Any:
    """Load what is asked for: an edge agent opens a session and needs no event loop for it."""
    if name not in _HOMES:
        raise AttributeError(f"module 'mesh.network' has no attribute {name!r}")
    from importlib import import_module

    return getattr(import_module(f"mesh.network.{_HOMES[name]}"), name)


__all__ = [
    "Channel",
    "Door",
    "Endpoints",
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
