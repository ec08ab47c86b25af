"""`aira lighthouse`: markets and their providers."""

from __future__ import annotations

from mesh.cli.lazy import LazyGroup

command = LazyGroup(
    "lighthouse",
    help="""Lighthouses, the markets: make one, look at them, become a provider of one.

    Stakes are in XRT (1.5), or with the ending wn in its smallest unit (1500000000wn). A lighthouse is named by its
    label (airalab), its ENS name or its address.""",
    lazy={
        "create": ("mesh.cli.lighthouse.create:command", "make a lighthouse"),
        "info": ("mesh.cli.lighthouse.info:command", "show one: its terms, its providers, whose turn it is"),
        "join": ("mesh.cli.lighthouse.join:command", "stake, and be a provider"),
        "leave": ("mesh.cli.lighthouse.leave:command", "take the stake back, or a part of it"),
        "list": ("mesh.cli.lighthouse.list:command", "list all lighthouses"),
    },
)
