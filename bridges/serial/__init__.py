"""Devices on serial lines. An agent calls its device through `Device`; `aira edge` connects the board.

```python
from bridges.serial import Device

board = Device(agent)
reply = await board.call("/blink_led", job=job)
```
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from schemas.loading import on_demand

if TYPE_CHECKING:
    from bridges.serial.device import CallReply, Device
    from bridges.serial.dialect import CallStatus
    from bridges.serial.errors import CallFailed, CallInDoubt, CallNotDone, CallRefused, NoSuchTopic

_NAMES: Final = {
    "bridges.serial.device": "CallReply Device",
    "bridges.serial.dialect": "CallStatus",
    "bridges.serial.errors": "CallFailed CallInDoubt CallNotDone CallRefused NoSuchTopic",
}

# An edge agent runs in a few tens of megabytes, so a name is imported when it is first used.
__getattr__ = on_demand(__name__, _NAMES)

__all__ = [
    "CallFailed",
    "CallInDoubt",
    "CallNotDone",
    "CallRefused",
    "CallReply",
    "CallStatus",
    "Device",
    "NoSuchTopic",
]
