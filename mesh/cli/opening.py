"""Chains and accounts as the settings name them, for commands that have an end."""

from __future__ import annotations

import asyncio
from contextlib import asynccontextmanager, contextmanager
from functools import partial
from typing import TYPE_CHECKING, Any, Final

import click

from mesh.cli.options import with_settings
from mesh.errors import ConfigurationError

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable, Iterator
    from pathlib import Path

    from mesh.chain import Chain
    from mesh.settings import Settings

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
PATIENCE: Final = 3.0
"""Seconds until it is said that a transaction is waited for."""


def for_reading(*more: str) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Give a command the settings of a chain that it only reads (the keyfile may say whose), and `more`."""
    return with_settings(*more, "keyfile", *CHAIN)


def for_signing(*more: str) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Give a command the settings of a chain on which it sends transactions, and `more`."""
    return with_settings(*more, *ACCOUNT[:2], *CHAIN, *ACCOUNT[2:])


@asynccontextmanager
async def reading(settings: Settings) -> AsyncIterator[Chain]:
    """The chain, open, for reading only. Raises `NodeUnreachable`, `NoContracts`."""
    from mesh.composition import chain_of

    async with chain_of(settings, None) as chain:
        yield chain


@asynccontextmanager
async def signing(settings: Settings) -> AsyncIterator[Chain]:
    """The chain, open, with the account of the settings. Raises also `ConfigurationError` for the account."""
    from mesh.composition import chain_of, load_account

    account = await asyncio.to_thread(load_account, settings)
    async with chain_of(settings, account) as chain:
        yield chain


def own_address(settings: Settings) -> str | None:
    """The address of the settings' keyfile, without its password; None where no keyfile is set.

    Raises `ConfigurationError` for a keyfile that can't be read, or does not say its address.
    """
    return claimed_address(settings.keyfile) if settings.keyfile else None


def needed_address(settings: Settings) -> str:
    """The same where there has to be one. Raises `ConfigurationError`."""
    address = own_address(settings)
    if address is None:
        raise ConfigurationError(
            "no account is named, and keyfile is not set", hint="name an address, or give --keyfile"
        )
    return address


def claimed_address(keyfile: str | Path) -> str:
    """The address that a keyfile claims, without its password. Raises `ConfigurationError`."""
    from pathlib import Path

    from mesh.chain import keyfile_address

    address = keyfile_address(Path(keyfile).expanduser())
    if address is None:
        raise ConfigurationError(f"{keyfile} does not say its address", hint="some keyfiles keep it to themselves")
    return address


@contextmanager
def patience() -> Iterator[None]:
    """Around what sends a transaction: when it takes longer, say to stderr what is waited for."""
    words = "waiting until the transaction is mined; Ctrl-C leaves it to the chain"
    timer = asyncio.get_running_loop().call_later(PATIENCE, partial(click.echo, words, err=True))
    try:
        yield
    finally:
        timer.cancel()
