"""`aira bridge`: bridges to other networks. Packages add theirs as entry points `bridge NAME`."""

from __future__ import annotations

from mesh.cli.lazy import LazyGroup

command = LazyGroup("bridge", installed="bridge ", help="Bridges to other networks.")
