"""The errors of the development chain's settings."""

from __future__ import annotations

from typing import TYPE_CHECKING

from mesh.errors import ConfigurationError

if TYPE_CHECKING:
    from pathlib import Path


class PortUnavailable(ConfigurationError, code="port-unavailable"):
    """A server can't listen on its port: it is taken, or this user may not have it."""

    def __init__(self, host: str, port: int, why: str, *, option: str = "--port") -> None:
        super().__init__(
            f"can't listen on {host}:{port}: {why}",
            hint=f"is another one running there? choose another with {option}; 0 selects a free one",
        )
        self.host = host
        self.port = port
        self.why = why


class NotAProgram(ConfigurationError, code="not-a-program"):
    """The file that is named as anvil can't be run."""

    def __init__(self, program: Path) -> None:
        super().__init__(f"{program} is not a program that can be run", hint="--anvil names the file `anvil`")
        self.program = program


class InvalidChainState(ConfigurationError, code="invalid-chain-state"):
    """The file holds no chain of anvil."""

    def __init__(self, state: Path) -> None:
        super().__init__(f"{state} does not contain a chain of anvil", hint="name another file, or remove it")
        self.state = state


class MarketMissing(ConfigurationError, code="market-missing"):
    """The chain in the file is not new, but has no market."""

    def __init__(self, state: Path | None) -> None:
        super().__init__(f"the chain in {state} is not new, but has no market", hint="name another file, or remove it")
        self.state = state


class KeyfilesNotWritable(ConfigurationError, code="keyfiles-not-writable"):
    """The keyfiles of the development accounts can't be written to their folder."""

    def __init__(self, folder: Path, why: str) -> None:
        super().__init__(f"can't write keyfiles to {folder}: {why}", hint="name another folder with --data-dir")
        self.folder = folder
        self.why = why
