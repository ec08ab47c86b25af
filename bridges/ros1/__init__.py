"""ROS 1 systems, without ROS: a node, a master, and the ROS graph of the legacy network in front of an agent.

```python
from bridges.ros1 import Ros1Graph, Ros1Node, Ros1ServiceType

SET_BOOL = Ros1ServiceType("std_srvs/SetBool", "bool data\\n---\\nbool success\\nstring message")
async with Ros1Node(Ros1Graph("http://127.0.0.1:11311"), "/aira") as node:
    reply = await node.call("/light", SET_BOOL, {"data": True})
```
"""

from __future__ import annotations

from schemas.loading import on_demand

__getattr__, __all__ = on_demand(__name__)
