"""Watching the mesh from outside: the events of a market, who is present, their status, their logs."""

from __future__ import annotations

from mesh.watching.market import JobEvent, MarketCounters, MarketEvent, MarketWatch, ReadingFetcher
from mesh.watching.presence import (
    BRIDGE,
    PROVIDER,
    PresenceChange,
    PresentPeer,
    RoleStatus,
    present,
    status_of,
    statuses,
)
from mesh.watching.robots import Robot, RobotDirectory, labelled, robot_address
