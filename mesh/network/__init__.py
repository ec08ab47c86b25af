"""Zenoh: sessions, the channel of verified messages, presence, services."""

from __future__ import annotations

from schemas.loading import on_demand

# An edge process opens a session without asyncio.
__getattr__, __all__ = on_demand(__name__)
