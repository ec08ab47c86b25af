"""The command line `aira`. A command is imported when it is called, so that small ones start fast."""

from __future__ import annotations

from typing import Final

import click

from mesh.cli.lazy import LazyGroup

COMMANDS: Final = {
    "account": ("mesh.cli.account:command", "create, import and show accounts"),
    "bridge": ("mesh.cli.bridge:command", "run a bridge to another network, such as IPFS"),
    "chain": ("mesh.cli.chain:command", "run a development chain; deploy and inspect contracts"),
    "cid": ("mesh.cli.cid:command", "print the CIDv0 of files"),
    "completion": ("mesh.cli.completion:command", "print the completion script of a shell"),
    "demand": ("mesh.cli.demand:demand", "order a job and wait for its result"),
    "demo": ("mesh.cli.demo:command", "run one job from demand to payment in one process"),
    "doctor": ("mesh.cli.doctor:command", "find problems on this machine and suggest fixes"),
    "health": ("mesh.cli.health:command", "check a server's health (exit code)"),
    "identity": ("mesh.cli.identity:command", "create and renew the certificates of a site"),
    "liability": ("mesh.cli.liability:command", "list, show, follow, stop and cancel liabilities"),
    "lighthouse": ("mesh.cli.lighthouse:command", "list and create lighthouses; become a provider"),
    "logs": ("mesh.cli.logs:command", "show the log of an agent, provider, bridge or device"),
    "model": ("mesh.cli.model:command", "write, check and show descriptions of models"),
    "new": ("mesh.cli.new:command", "write a project of a robot, a client or a validator"),
    "objective": ("mesh.cli.objective:command", "create, show, check and fetch objectives and recordings"),
    "order": ("mesh.cli.order:command", "list and withdraw open orders"),
    "peers": ("mesh.cli.status:peers", "list the peers on a lighthouse's channel"),
    "provider": ("mesh.cli.provider:command", "match the orders of a lighthouse and settle them"),
    "quotes": ("mesh.cli.quotes:command", "ask the robots of a model what they want for a job"),
    "replay": ("mesh.cli.replay:command", "publish the messages of a recording again"),
    "robot": ("mesh.cli.robot:command", "change how a robot works while it runs; stop and release it"),
    "robots": ("mesh.cli.robots:command", "list the robots on a lighthouse's channel"),
    "router": ("mesh.cli.router:command", "run a Zenoh router for the mesh"),
    "rpc": ("mesh.cli.rpc:command", "call a service of an agent"),
    "settings": ("mesh.cli.settings:command", "show the effective settings"),
    "signer": ("mesh.cli.signer:command", "order for programs what a policy allows; it has the key"),
    "state": ("mesh.cli.state:command", "show, back up and restore the state of agents"),
    "statement": ("mesh.cli.statement:statement", "show what an account has earned and spent, by contract and month"),
    "status": ("mesh.cli.status:status", "show the status of agents, providers and bridges"),
    "stop": ("mesh.cli.stop:command", "stop the robots of this machine, or release them"),
    "up": ("mesh.cli.up:command", "run a router, a chain and a provider for development"),
    "validator": ("mesh.cli.validator:command", "judge results before they are paid; deploy a validator contract"),
    "verify": ("mesh.cli.verify:command", "check a recording against its objective and its liability"),
    "watch": ("mesh.cli.watch:command", "print what happens on a market"),
    "xrt": ("mesh.cli.xrt:command", "show, approve and transfer XRT and other tokens"),
}
"""Name → (`module:attribute` of the command, its short help). Installed packages add more by entry points."""


@click.group(cls=LazyGroup, lazy=COMMANDS, installed="", context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(package_name="aira-mesh", prog_name="aira")
def main() -> None:
    """AIRA mesh: robots and people trade work without a middleman. Start with `aira demo`."""
