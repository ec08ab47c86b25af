"""Devices on serial lines: what an edge agent speaks with a board, and what the mesh hears of it."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from schemas.loading import on_demand

if TYPE_CHECKING:
    from bridges.serial.boards import BoardFailed, PinChange, SimulatedBoard
    from bridges.serial.calling import CallingDialect
    from bridges.serial.device import Answer, Device
    from bridges.serial.device_id import DeviceId
    from bridges.serial.dialect import Ending
    from bridges.serial.edge import Edge
    from bridges.serial.errors import CallFailed, CallInDoubt, CallNotDone, CallRefused, LineError, PortMissing
    from bridges.serial.ports import PortName
    from bridges.serial.rosserial import RosserialDialect

_HOMES: Final = {
    "Answer": "bridges.serial.device",
    "BoardFailed": "bridges.serial.boards",
    "CallFailed": "bridges.serial.errors",
    "CallInDoubt": "bridges.serial.errors",
    "CallNotDone": "bridges.serial.errors",
    "CallRefused": "bridges.serial.errors",
    "CallingDialect": "bridges.serial.calling",
    "Device": "bridges.serial.device",
    "DeviceId": "bridges.serial.device_id",
    "Edge": "bridges.serial.edge",
    "Ending": "bridges.serial.dialect",
    "LineError": "bridges.serial.errors",
    "PinChange": "bridges.serial.boards",
    "PortMissing": "bridges.serial.errors",
    "PortName": "bridges.serial.ports",
    "RosserialDialect": "bridges.serial.rosserial",
    "SimulatedBoard": "bridges.serial.boards",
}

# An edge agent runs in a few tens of megabytes and pays only for what it uses.
__getattr__ = on_demand(__name__, _HOMES)

__all__ = [
    "Answer",
    "BoardFailed",
    "CallFailed",
    "CallInDoubt",
    "CallNotDone",
    "CallRefused",
    "CallingDialect",
    "Device",
    "DeviceId",
    "Edge",
    "Ending",
    "LineError",
    "PinChange",
    "PortMissing",
    "PortName",
    "RosserialDialect",
    "SimulatedBoard",
]
