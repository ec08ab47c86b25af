"""Tokens, accounts and spenders as commands name them."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

from mesh.cli.amounts import XRT, Unit
from mesh.cli.opening import needed_address
from mesh.errors import ChainError

if TYPE_CHECKING:
    from mesh.chain import Chain
    from mesh.settings import Settings

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
        return await asyncio.to_thread(needed_address, settings)
    return await chain.names.address(named)


async def spender_of(chain: Chain, named: str) -> str:
    """The address of who may take tokens: `factory`, a lighthouse's label, an ENS name or an address."""
    if named == FACTORY:
        return chain.factory
    return await chain.names.lighthouse(named)


async def check_enough(chain: Chain, unit: Unit, needed: int, *, token: str | None = None) -> None:
    """Raise `ChainError` when the chain's account holds less of a token than it is to give."""
    assert chain.account is not None
    balance = await chain.tokens.balance(token=token)
    if balance < needed:
        raise ChainError(
            f"{chain.account.address} has {unit.show(balance)}, and {unit.show(needed)} are needed",
            hint="send it what is missing, or give a smaller amount",
        )
