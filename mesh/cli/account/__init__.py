"""`aira account`: keyfiles."""

from __future__ import annotations

from mesh.cli.lazy import LazyGroup

command = LazyGroup(
    "account",
    help="Make, import and look at accounts: keyfiles in the Web3 secret storage format.",
    lazy={
        "import": ("mesh.cli.account.importing:command", "write a key that there is already to a keyfile"),
        "new": ("mesh.cli.account.new:command", "make an account"),
        "show": ("mesh.cli.account.show:command", "print the address, and what the account holds"),
    },
)
