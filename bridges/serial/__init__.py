"""Devices on serial lines. An agent calls its device through `Device`; `aira edge` connects the board.

```python
from bridges.serial import Device

board = Device(agent)
reply = await board.call("/blink_led", job=job)
```
"""

from __future__ import annotations

from schemas.loading import on_demand

# An edge agent runs in a few tens of megabytes.
__getattr__, __all__ = on_demand(__name__)
