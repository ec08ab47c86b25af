"""Devices on serial lines: what an edge agent speaks with a board, and what the mesh hears of it."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

if TYPE_CHECKING:
    from bridges.serial.boards import BoardFailed, PinChange, SimulatedBoard
    from bridges.serial.calling import CallingDialect
    from bridges.serial.device import Answer, Device
    from bridges.serial.dialect import Ending
    from bridges.serial.edge import DeviceId, Edge
    from bridges.serial.errors import CallFailed, CallInDoubt, CallNotDone, CallRefused, LineError, PortMissing
    from bridges.serial.ports import PortName
    from bridges.serial.rosserial import RosserialDialect

_HOMES: Final = {
    "Answer": "device",
    "BoardFailed": "boards",
    "CallFailed": "errors",
    "CallInDoubt": "errors",
    "CallNotDone": "errors",
    "CallRefused": "errors",
    "CallingDialect": "calling",
    "Device": "device",
    "DeviceId": "edge",
    "Edge": "edge",
    "Ending": "dialect",
    "LineError": "errors",
    "PinChange": "boards",
    "PortMissing": "errors",
    "PortName": "ports",
    "RosserialDialect": "rosserial",
    "SimulatedBoard": "boards",
}


def __getattr__(name: str) -> Any:
    """Load what is asked for: an edge agent runs in a few tens of megabytes and pays only for what it uses."""
    if name not in _HOMES:
        raise AttributeError(f"module 'bridges.serial' has no attribute {name!r}")
    from importlib import import_module

    return getattr(import_module(f"bridges.serial.{_HOMES[name]}"), name)


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
