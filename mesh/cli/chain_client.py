"""What commands share that use a chain: opening it, and finding accounts, tokens and their units."""

from __future__ import annotations

import asyncio
from contextlib import asynccontextmanager, contextmanager
from functools import partial
from typing import TYPE_CHECKING, Final

import click

from mesh.cli.amounts import XRT, Unit
from mesh.cli.output import short_address
from mesh.errors import ChainError, ConfigurationError

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Iterable, Iterator
    from pathlib import Path

    from mesh.chain import Chain
    from mesh.settings import Settings
    from schemas.records import Liability


PATIENCE: Final = 3.0
"""Seconds until it is said that a transaction is waited for."""


@asynccontextmanager
async def open_chain(settings: Settings) -> AsyncIterator[Chain]:
    """The chain, open, for reading only. Raises `NodeUnreachable`, `NoContracts`."""
    from mesh.composition import chain_of

    async with chain_of(settings, None) as chain:
        yield chain


@asynccontextmanager
async def open_signing_chain(settings: Settings) -> AsyncIterator[Chain]:
    """The chain, open, with the account of the settings. Raises also `ConfigurationError` for the account."""
    from mesh.composition import chain_of, load_account

    account = await asyncio.to_thread(load_account, settings)
    async with chain_of(settings, account) as chain:
        yield chain


def own_address(settings: Settings) -> str | None:
    """The address of the settings' keyfile, without its password; None where no keyfile is set.

    Raises `ConfigurationError` for a keyfile that can't be read, or does not say its address.
    """
    return address_in_keyfile(settings.keyfile) if settings.keyfile else None


def required_address(settings: Settings) -> str:
    """The same where there has to be one. Raises `ConfigurationError`."""
    address = own_address(settings)
    if address is None:
        raise ConfigurationError(
            "no account is named, and keyfile is not set", hint="name an address, or give --keyfile"
        )
    return address


def address_in_keyfile(keyfile: str | Path) -> str:
    """The address that a keyfile claims, without its password. Raises `ConfigurationError`."""
    from pathlib import Path

    from mesh.chain import keyfile_address

    address = keyfile_address(Path(keyfile).expanduser())
    if address is None:
        raise ConfigurationError(f"{keyfile} does not say its address", hint="some keyfiles keep it to themselves")
    return address


@contextmanager
def notice_when_slow() -> Iterator[None]:
    """Around what sends a transaction: when it takes longer, say to stderr what is waited for."""
    words = "waiting until the transaction is mined; Ctrl-C leaves it to the chain"
    timer = asyncio.get_running_loop().call_later(PATIENCE, partial(click.echo, words, err=True))
    try:
        yield
    finally:
        timer.cancel()


FACTORY = "factory"


async def unit_of(chain: Chain, token: str | None) -> Unit:
    """The unit of a token (ENS name or address; XRT by default), as it says itself. Raises `ChainError` for none."""
    from mesh.chain import NoContracts, Reverted

    try:
        said = await chain.tokens.info(token)
    except (NoContracts, Reverted):
        if token is None:
            raise
        raise ChainError(f"{token} is no token", hint="--token names an ERC-20 by its address or ENS name") from None
    if said.address == chain.xrt:
        return Unit(said.symbol or XRT.symbol, said.decimals, XRT.smallest)
    return Unit(said.symbol or "tokens", said.decimals)


async def account_of(chain: Chain, settings: Settings, named: str | None) -> str:
    """The address of a named account (ENS name or address), of the settings' where none is named."""
    if named is None:
        return await asyncio.to_thread(required_address, settings)
    return await chain.names.address(named)


async def spender_of(chain: Chain, named: str) -> str:
    """The address of who may take tokens: `factory`, a lighthouse's label, an ENS name or an address."""
    if named == FACTORY:
        return chain.factory
    return await chain.names.lighthouse(named)


async def check_balance(chain: Chain, unit: Unit, needed: int, *, token: str | None = None) -> None:
    """Raise `ChainError` when the chain's account holds less of a token than it is to give."""
    assert chain.account is not None
    balance = await chain.tokens.balance(token=token)
    if balance < needed:
        raise ChainError(
            f"{chain.account.address} has {unit.show(balance)}, and {unit.show(needed)} are needed",
            hint="send it what is missing, or give a smaller amount",
        )


async def units_of(chain: Chain, liabilities: Iterable[Liability]) -> dict[str, Unit]:
    """The units of the tokens that liabilities are paid in, by the tokens' addresses.

    A token but XRT is named with its address, for it may call itself anything; one that says nothing counts in its
    smallest unit.
    """
    return {token: await _unit_of(chain, token) for token in {liability.token for liability in liabilities}}


async def _unit_of(chain: Chain, token: str) -> Unit:
    if token == chain.xrt:
        return await unit_of(chain, None)
    try:
        unit = await unit_of(chain, token)
    except ChainError:
        return Unit(f"units of {short_address(token)}", 0)
    return Unit(f"{unit.symbol} ({short_address(token)})", unit.decimals)
