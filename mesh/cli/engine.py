"""Which program runs a chain to develop on: anvil, or this one."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from mesh.errors import ConfigurationError

if TYPE_CHECKING:
    from collections.abc import Callable


def with_engine(function: Callable[..., Any]) -> Callable[..., Any]:
    """Give a command the options `engine`, `anvil` and `state`, which `chosen` understands."""
    engine = click.option(
        "--engine",
        type=click.Choice(["auto", "anvil", "embedded"]),
        default="auto",
        show_default=True,
        help="what runs the chain; auto takes anvil where it is found",
    )
    anvil = click.option("--anvil", type=click.Path(path_type=Path), help="the program anvil [the one on the path]")
    kept = click.Path(dir_okay=False, path_type=Path)
    state = click.option("--state", type=kept, help="file that anvil keeps the chain in")
    return engine(anvil(state(function)))


def chosen(*, engine: str, anvil: Path | None, state: Path | None) -> Path | None:
    """The program anvil, or None for the embedded chain. Raises `ConfigurationError`."""
    from mesh.devchain.anvil import find_anvil

    program = None if engine == "embedded" else find_anvil(anvil)
    if engine == "anvil" and program is None:
        raise ConfigurationError(
            "anvil is not on the path", hint="name it with --anvil FILE, or take --engine embedded, which needs nothing"
        )
    if state is not None and program is None:
        raise ConfigurationError(
            "only anvil can keep the chain in a file, and the embedded chain was "
            + ("asked for" if engine == "embedded" else "taken, as anvil is not on the path"),
            hint="name anvil with --anvil FILE, or leave --state out",
        )
    return program
