"""The command line `aira`. Commands are loaded when they are called, so that small ones start fast."""

from __future__ import annotations

from typing import Final

import click

from mesh.cli.lazy import LazyGroup

COMMANDS: Final = {
    "account": ("mesh.cli.account", "make, import and look at accounts"),
    "board": ("bridges.serial.board_cli", "run firmware on a board that is not there"),
    "bridge": ("mesh.cli.bridge", "doors to other networks: IPFS"),
    "chain": ("mesh.cli.chain", "a chain to develop on, and the contracts on any chain"),
    "cid": ("mesh.cli.cid", "print the CIDv0 of files"),
    "demand": ("mesh.cli.demand", "ask for a job and wait for its result"),
    "demo": ("mesh.cli.demo", "one job from demand to payment, in one process"),
    "doctor": ("mesh.cli.doctor", "what is wrong on this machine, and what to do about it"),
    "edge": ("bridges.serial.cli", "bring a device on a serial line into the mesh"),
    "health": ("mesh.cli.health", "how a server is, by its exit code"),
    "identity": ("mesh.cli.identity", "certificates: who belongs to a site"),
    "liability": ("mesh.cli.liability", "look at contracts, follow them, call them off"),
    "lighthouse": ("mesh.cli.lighthouse", "make markets, look at them, become a provider"),
    "logs": ("mesh.cli.logs", "what an agent, a provider or a bridge logs"),
    "objective": ("mesh.cli.objective", "make, show, check, fetch objectives and recordings"),
    "peers": ("mesh.cli.peers", "who is on a lighthouse's channel"),
    "provider": ("mesh.cli.provider", "match the orders of a lighthouse"),
    "replay": ("mesh.cli.replay", "play a recording again onto keys of the mesh"),
    "router": ("mesh.cli.router", "a Zenoh router for a mesh"),
    "rpc": ("mesh.cli.rpc", "call a service of an agent"),
    "settings": ("mesh.cli.settings", "show the settings in force"),
    "state": ("mesh.cli.state", "what agents remember: look at it, back it up, restore it"),
    "status": ("mesh.cli.status", "how agents, providers and bridges are"),
    "up": ("mesh.cli.up", "router, chain and provider in one process, for development"),
    "verify": ("mesh.cli.verify", "check a recording against its objective and its contract"),
    "watch": ("mesh.cli.watch", "a market as it happens"),
    "xrt": ("mesh.cli.xrt", "balances, allowances and transfers of XRT and other tokens"),
}
"""Name → (module that holds the command under the name `command`, one line of help)."""


@click.group(cls=LazyGroup, commands=COMMANDS, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(package_name="aira-mesh", prog_name="aira")
def main() -> None:
    """AIRA mesh: robots and people trade work without a middleman. `aira demo` shows all of it."""
