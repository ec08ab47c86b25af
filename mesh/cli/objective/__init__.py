"""`aira objective`: what a robot is to do, as a file."""

from __future__ import annotations

from mesh.cli.lazy import LazyGroup

command = LazyGroup(
    "objective",
    help="""Objectives and recordings: MCAP files (or ROS 1 bags) with the messages that a robot is to be told, or has
    said.""",
    lazy={
        "add": ("mesh.cli.objective.add:command", "put files into the store, where robots can fetch them"),
        "check": ("mesh.cli.objective.check:command", "whether a robot would take it; or the whole store"),
        "convert": ("mesh.cli.objective.convert:command", "make MCAP of a ROS 1 bag, without losing anything"),
        "get": ("mesh.cli.objective.get:command", "fetch a file by its CID"),
        "pack": ("mesh.cli.objective.pack:command", "make one of JSON lines, or of what is said on topics now"),
        "recover": ("mesh.cli.objective.recover:command", "save what is readable of a file that was cut"),
        "show": ("mesh.cli.objective.show:command", "summary, topics, schemas, and when the messages come"),
    },
)
