"""ROS 2 systems over Zenoh, without ROS: `Robot` speaks rmw_zenoh, and the keys of zenoh-bridge-ros2dds."""

from __future__ import annotations

from schemas.loading import on_demand

__getattr__, __all__ = on_demand(__name__)
