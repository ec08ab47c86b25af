"""`aira bridge`: doors to other networks."""

from __future__ import annotations

from mesh.cli.lazy import LazyGroup

command = LazyGroup(
    "bridge",
    commands={"ipfs": ("bridges.ipfs.cli", "the legacy network's IPFS PubSub channel, and its content")},
    help="Doors to other networks.",
)
