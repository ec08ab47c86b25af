"""The options of whoever makes a lighthouse: the rules by which its providers work."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import click

if TYPE_CHECKING:
    from collections.abc import Callable


def with_rules(command: Callable[..., Any]) -> Callable[..., Any]:
    """Give a command `--minimal-stake` and `--timeout-blocks`."""
    stake = click.option(
        "--minimal-stake", default="1", show_default=True, help="what a provider stakes at least, XRT (or 5wn)"
    )
    timeout = click.option(
        "--timeout-blocks",
        type=click.IntRange(1, 2**32 - 1),
        default=25,
        show_default=True,
        help="silence, in blocks, after which another provider may take the turn",
    )
    return stake(timeout(command))
