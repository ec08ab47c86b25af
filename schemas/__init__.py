"""What travels in the mesh: messages, keys, CIDs, hashes and signatures. Pure: no network, no chain, no disk."""

from __future__ import annotations

from schemas.loading import on_demand

# A device's agent uses keys and payloads, and must not load what signatures need.
__getattr__, __all__ = on_demand(__name__)
