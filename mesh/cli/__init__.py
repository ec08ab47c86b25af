"""The command line `aira`. Commands are loaded when they are called, so that small ones start fast."""

from __future__ import annotations

from typing import Final

import click

from mesh.cli.lazy import LazyGroup

COMMANDS: Final = {
    "account": ("mesh.cli.account:command", "make, import and look at accounts"),
    "bridge": ("mesh.cli.bridge:command", "bridges to other networks: IPFS"),
    "chain": ("mesh.cli.chain:command", "a chain to develop on, and the contracts on any chain"),
    "cid": ("mesh.cli.cid:command", "print the CIDv0 of files"),
    "demand": ("mesh.cli.demand:command", "ask for a job and wait for its result"),
    "demo": ("mesh.cli.demo:command", "one job from demand to payment, in one process"),
    "doctor": ("mesh.cli.doctor:command", "what is wrong on this machine, and what to do about it"),
    "health": ("mesh.cli.health:command", "how a server is, by its exit code"),
    "identity": ("mesh.cli.identity:command", "certificates: who belongs to a site"),
    "liability": ("mesh.cli.liability:command", "look at contracts, follow them, call them off"),
    "lighthouse": ("mesh.cli.lighthouse:command", "make markets, look at them, become a provider"),
    "logs": ("mesh.cli.logs:command", "what an agent, a provider or a bridge logs"),
    "objective": ("mesh.cli.objective:command", "make, show, check, fetch objectives and recordings"),
    "peers": ("mesh.cli.status:peers", "who is on a lighthouse's channel"),
    "provider": ("mesh.cli.provider:command", "match the orders of a lighthouse"),
    "replay": ("mesh.cli.replay:command", "play a recording again onto keys of the mesh"),
    "router": ("mesh.cli.router:command", "a Zenoh router for a mesh"),
    "rpc": ("mesh.cli.rpc:command", "call a service of an agent"),
    "settings": ("mesh.cli.settings:command", "show the settings in force"),
    "state": ("mesh.cli.state:command", "what agents remember: look at it, back it up, restore it"),
    "status": ("mesh.cli.status:status", "how agents, providers and bridges are"),
    "up": ("mesh.cli.up:command", "router, chain and provider in one process, for development"),
    "verify": ("mesh.cli.verify:command", "check a recording against its objective and its contract"),
    "watch": ("mesh.cli.watch:command", "a market as it happens"),
    "xrt": ("mesh.cli.xrt:command", "balances, allowances and transfers of XRT and other tokens"),
}
"""Name → (where the command is, its line of help). Installed packages add more by entry points."""


@click.group(cls=LazyGroup, lazy=COMMANDS, installed="", context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(package_name="aira-mesh", prog_name="aira")
def main() -> None:
    """AIRA mesh: robots and people trade work without a middleman. `aira demo` shows all of it."""
