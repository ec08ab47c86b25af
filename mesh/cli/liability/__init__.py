"""`aira liability`: contracts between those who want work done and those who do it."""

from __future__ import annotations

from mesh.cli.lazy import LazyGroup

command = LazyGroup(
    "liability",
    help="""Liabilities, the contracts that hold the money of a job until it is done.

    The promisee asks for the work and pays, the promisor does it.""",
    lazy={
        "cancel": (
            "mesh.cli.liability.cancel:command",
            "call the work off together, or have the money back after the delay",
        ),
        "list": ("mesh.cli.liability.list:command", "list those of an account, or all"),
        "show": ("mesh.cli.liability.show:command", "show one: who, what, the money, how it stands"),
        "watch": ("mesh.cli.liability.watch:command", "follow one until it has ended, or all that are made"),
    },
)
