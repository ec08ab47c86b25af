"""Options that commands share, such as one flag for each setting that a command uses."""

from __future__ import annotations

from functools import wraps
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import click

from mesh.errors import AiraError
from mesh.running import fail
from mesh.settings import MEANING, Settings, load

if TYPE_CHECKING:
    from collections.abc import Callable


SEVERAL = frozenset({"connect", "link", "listen", "ipfs_public_providers", "ipfs_swarm_connect"})


PORT = click.IntRange(0, 65_535)


BLOCK_TIME = click.FloatRange(0.01, 86_400)
"""Seconds."""


def with_settings(*names: str) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Give a command `--config` and a flag for each named setting; it is called with `settings`.

    The settings come from the file, the `AIRA_*` variables and the flags, in that order of rising precedence.
    """

    def decorate(function: Callable[..., Any]) -> Callable[..., Any]:
        @wraps(function)
        def command(config: Path | None, **options: Any) -> Any:
            flags = {name: _given(options.pop(name)) for name in names}
            try:
                settings = load(path=config, flags=flags)
            except AiraError as error:
                fail(error)
            return function(settings=settings, **options)

        decorated: Callable[..., Any] = command
        for name in reversed(names):
            decorated = _flag(name)(decorated)
        return click.option(
            "--config",
            type=click.Path(dir_okay=False, path_type=Path),
            envvar="AIRA_CONFIG",
            help="settings file (TOML)",
        )(decorated)

    return decorate


def _given(value: str | tuple[str, ...] | None) -> str | tuple[str, ...] | None:
    """A flag's value, None if it was not given: an empty text sets the option to nothing, an empty list can't be told
    from no flag at all."""
    return None if value == () else value


def _flag(name: str) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    default = getattr(Settings(), name)
    shown = ", ".join(default) if isinstance(default, tuple) else str(default)
    text = MEANING[name] + (f" [{shown}]" if shown else "")
    flag = f"--{name.replace('_', '-')}"
    return click.option(flag, name, multiple=name in SEVERAL, metavar=name.split("_")[-1].upper(), help=text)


def with_json(function: Callable[..., Any]) -> Callable[..., Any]:
    """Give a command the flag `--json`; it is called with `as_json`."""
    return click.option("--json", "as_json", is_flag=True, help="print JSON, and nothing else, to stdout")(function)


CHAIN: Final = (
    "web3_http_provider",
    "ens_contract",
    "factory_contract",
    "xrt_contract",
    "generation",
    "contracts",
)
"""The settings that say which chain, and which contracts on it."""


ACCOUNT: Final = ("keyfile", "keyfile_password_file", "data_dir", "max_fee_gwei", "confirmations", "poll_interval")
"""Those that say who acts, and how transactions are sent."""


def with_chain_settings(*more: str) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Give a command the settings of a chain that it only reads (the keyfile may say whose), and `more`."""
    return with_settings(*more, "keyfile", *CHAIN)


def with_signing_settings(*more: str) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Give a command the settings of a chain on which it sends transactions, and `more`."""
    return with_settings(*more, *ACCOUNT[:2], *CHAIN, *ACCOUNT[2:])


def with_lighthouse_options(command: Callable[..., Any]) -> Callable[..., Any]:
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
