"""Shared by commands that use a chain: opening it, and finding accounts, tokens and their units."""

from __future__ import annotations

import asyncio
from contextlib import asynccontextmanager, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Final

import click

from mesh.errors import ChainError, ConfigurationError

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Iterable, Iterator

    from mesh.amounts import Unit
    from mesh.chain import Chain
    from mesh.settings import AccountSettings, Settings
    from schemas import Order
    from schemas.records import Liability

FACTORY: Final = "factory"
READ_ATTEMPTS: Final = 2
"""Of a command that only reads: its user sees at once that a node is missing, and can repeat it."""


def open_chain(settings: Settings) -> Chain:
    """The chain of the settings, for reading: `async with` opens it. Raises `ConfigurationError`."""
    from mesh.role.composition import chain_of

    return chain_of(settings, None, attempts=READ_ATTEMPTS)


@asynccontextmanager
async def open_signing_chain(settings: Settings) -> AsyncIterator[Chain]:
    """The chain of the settings, opened with their account. Also raises `ConfigurationError` for the account."""
    from mesh.role.composition import chain_of, load_account

    account = await asyncio.to_thread(load_account, settings)
    async with chain_of(settings, account) as chain:
        yield chain


@contextmanager
def notice_when_slow() -> Iterator[None]:
    """Print to stderr that a command is waiting for its transaction, if this takes more than three seconds."""

    def notice() -> None:
        click.echo("waiting until the transaction is mined; Ctrl-C stops waiting, but does not cancel it", err=True)

    timer = asyncio.get_running_loop().call_later(3, notice)
    try:
        yield
    finally:
        timer.cancel()


def own_address(settings: AccountSettings) -> str | None:
    """The address in the settings' keyfile, which needs no password; None if no keyfile is set.

    Raises `ConfigurationError` for a keyfile that can't be read, or has no address in it.
    """
    return address_in_keyfile(settings.keyfile) if settings.keyfile else None


def required_address(settings: AccountSettings) -> str:
    """The address in the settings' keyfile. Raises `ConfigurationError` also if no keyfile is set."""
    address = own_address(settings)
    if address is None:
        raise ConfigurationError(
            "no account: neither an address nor a keyfile is given",
            hint="give an address or --keyfile",
            code="account-missing",
        )
    return address


def address_in_keyfile(keyfile: str | Path) -> str:
    """The address that a keyfile states, read without its password. Raises `ConfigurationError`."""
    from mesh.chain import keyfile_address

    address = keyfile_address(Path(keyfile).expanduser())
    if address is None:
        raise ConfigurationError(
            f"{keyfile} does not contain its address",
            hint="the address is optional in keyfiles; use a keyfile with one",
            code="account-missing",
        )
    return address


async def account_of(chain: Chain, settings: AccountSettings, named: str | None) -> str:
    """The address of an account by its ENS name or address; by default the settings' own."""
    if named is None:
        return await asyncio.to_thread(required_address, settings)
    return await chain.names.address(named)


async def spender_of(chain: Chain, named: str) -> str:
    """The address of a spender: `factory`, a lighthouse's label, an ENS name or an address."""
    if named == FACTORY:
        return chain.factory
    return await chain.names.lighthouse(named)


async def units_of(chain: Chain, paid: Iterable[Liability | Order]) -> dict[str, Unit]:
    """The units of the tokens that liabilities or orders are paid in, by the tokens' addresses."""
    return await chain.tokens.units(one.token for one in paid)


async def check_balance(chain: Chain, unit: Unit, needed: int, *, token: str | None = None) -> None:
    """Raise `ChainError` when the chain's account has less than `needed` of a token."""
    assert chain.account is not None
    balance = await chain.tokens.balance(token=token)
    if balance < needed:
        raise ChainError(
            f"{chain.account.address} has {unit.show(balance)}, but needs {unit.show(needed)}",
            hint="transfer more to the account, or use a smaller amount",
            code="balance-too-low",
        )
