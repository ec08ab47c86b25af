"""`aira chain`: a chain for development, the contracts on any other, and what there is on one."""

from __future__ import annotations

from mesh.cli.lazy import LazyGroup

command = LazyGroup(
    "chain",
    help="A chain to develop on, and the network's contracts on any chain.",
    lazy={
        "deploy": ("mesh.cli.chain.deploy:command", "put the contracts on a chain"),
        "status": ("mesh.cli.chain.status:command", "show the node, the contracts and the account's money"),
        "up": ("mesh.cli.chain.up:command", "serve a chain with the contracts, for development"),
    },
)
