"""The command line `aira`. Commands are loaded when they are called, so that small ones start fast."""

from __future__ import annotations

from typing import Final

import click

import mesh
from mesh.cli.lazy import LazyGroup

COMMANDS: Final = {
    "account": ("mesh.cli.account", "make and look at accounts"),
    "chain": ("mesh.cli.chain", "a chain for development"),
    "cid": ("mesh.cli.cid", "print the CIDv0 of files"),
    "demand": ("mesh.cli.demand", "ask for a job and wait for its result"),
    "demo": ("mesh.cli.demo", "one job from demand to payment, in one process"),
    "provider": ("mesh.cli.provider", "match the orders of a lighthouse"),
    "router": ("mesh.cli.router", "a Zenoh router for a mesh"),
    "settings": ("mesh.cli.settings", "show the settings in force"),
    "up": ("mesh.cli.up", "router, chain and provider in one process, for development"),
}
"""Name → (module that holds the command under the name `command`, one line of help)."""


@click.group(cls=LazyGroup, commands=COMMANDS, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(mesh.__version__, prog_name="aira")
def main() -> None:
    """AIRA mesh: robots and people trade work without a middleman. `aira demo` shows all of it."""
