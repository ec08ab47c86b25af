"""Seeing what goes on from anywhere in the mesh: a market as it happens, who is there, how each of them is."""

from __future__ import annotations

from mesh.watching.claims import JobEvent
from mesh.watching.market import MarketWatch, Seen
from mesh.watching.presence import How, Peer, address_of, present, role_of, status_of, statuses
from mesh.watching.readings import Reading, Readings
from mesh.watching.tally import Tally

__all__ = [
    "How",
    "JobEvent",
    "MarketWatch",
    "Peer",
    "Reading",
    "Readings",
    "Seen",
    "Tally",
    "address_of",
    "present",
    "role_of",
    "status_of",
    "statuses",
]
