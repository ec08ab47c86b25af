"""`aira xrt`: tokens, XRT or any other ERC-20."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import click

from mesh.cli.chain_client import (
    FACTORY,
    account_of,
    check_balance,
    notice_when_slow,
    open_chain,
    open_signing_chain,
    spender_of,
)
from mesh.cli.options import ADDRESS, TOKEN, TokenAmountText, with_chain_settings, with_json, with_signing_settings
from mesh.cli.output import print_result

if TYPE_CHECKING:
    from mesh.amounts import Unit
    from mesh.chain import Chain
    from mesh.settings import Settings

with_token = click.option(
    "--token", type=TOKEN, help="another ERC-20 token: its address, ENS name, or symbol if that is known [XRT]"
)


@click.group("xrt")
def command() -> None:
    """Show, approve and transfer XRT, the token of stakes and fees, or any other ERC-20.

    A plain AMOUNT counts whole tokens: 1.5 is one and a half XRT. With the suffix wn (10^-9 XRT), or units for any
    token, it counts the smallest unit: 1500000000wn is the same amount. An amount may name its token instead of
    --token: 3.50 USDC, or 3.50 0x… with its address. In JSON, amounts are text in the smallest unit.
    """


@command.command("balance", short_help="show an account's balance")
@click.argument("account", required=False, type=ADDRESS)
@with_token
@with_json
@with_chain_settings()
async def balance(settings: Settings, *, account: str | None, token: str | None, as_json: bool) -> None:
    """Show the balance of ACCOUNT, an address or ENS name; by default the account of the settings."""
    async with open_chain(settings) as chain:
        owner = await account_of(chain, settings, account)
        unit = await chain.tokens.unit(token)
        amount = await chain.tokens.balance(owner, token=token)
        result = {"account": owner, **await _token_json(chain, token, unit), "balance": str(amount)}
        print_result(result, unit.show(amount), as_json=as_json)


@command.command("allowance", short_help="show how much a spender may transfer from an account")
@click.argument("spender", default=FACTORY)
@click.option("--owner", type=ADDRESS, help="address or ENS name of the owner [the settings' account]")
@with_token
@with_json
@with_chain_settings()
async def allowance(settings: Settings, *, spender: str, owner: str | None, token: str | None, as_json: bool) -> None:
    """Show how much SPENDER may transfer from the account.

    SPENDER is `factory` (the default), a lighthouse's name, an ENS name or an address."""
    async with open_chain(settings) as chain:
        whose, by = await account_of(chain, settings, owner), await spender_of(chain, spender)
        unit = await chain.tokens.unit(token)
        amount = await chain.tokens.allowance(whose, by, token=token)
        result = {"owner": whose, "spender": by, **await _token_json(chain, token, unit), "allowance": str(amount)}
        print_result(result, unit.show(amount), as_json=as_json)


@command.command("approve", short_help="allow a spender to transfer up to an amount")
@click.argument("spender")
@click.argument("amount", type=TokenAmountText())
@with_token
@with_json
@with_signing_settings()
async def approve(settings: Settings, *, spender: str, amount: str, token: str | None, as_json: bool) -> None:
    """Allow SPENDER to transfer up to AMOUNT from the account. Replaces the previous allowance; 0 revokes it.

    SPENDER is `factory` (for costs and fees), a lighthouse's name (for stakes), an ENS name or an address.
    """
    async with open_signing_chain(settings) as chain:
        token, unit, (value,) = await chain.tokens.amounts(amount, token=token or "")
        by = await spender_of(chain, spender)
        with notice_when_slow():
            tx = await chain.tokens.approve(by, value, token=token)
        result = {"spender": by, **await _token_json(chain, token, unit), "allowance": str(value), "tx": tx}
        facts = {"spender": by, "allowance": unit.show(value), "transaction": tx}
        print_result(result, facts, as_json=as_json)


@command.command("transfer", short_help="transfer an amount to another account")
@click.argument("to", type=ADDRESS)
@click.argument("amount", type=TokenAmountText())
@with_token
@with_json
@with_signing_settings()
async def transfer(settings: Settings, *, to: str, amount: str, token: str | None, as_json: bool) -> None:
    """Transfer AMOUNT from the account to TO, an address or ENS name."""
    async with open_signing_chain(settings) as chain:
        token, unit, (value,) = await chain.tokens.amounts(amount, token=token or "")
        recipient = await chain.names.address(to)
        await check_balance(chain, unit, value, token=token)
        with notice_when_slow():
            tx = await chain.tokens.transfer(recipient, value, token=token)
        left = await chain.tokens.balance(token=token)
        about = {"to": recipient, **await _token_json(chain, token, unit)}
        facts = {"sent": unit.show(value), "to": recipient, "left": unit.show(left), "transaction": tx}
        print_result(about | {"amount": str(value), "balance": str(left), "tx": tx}, facts, as_json=as_json)


async def _token_json(chain: Chain, token: str | None, unit: Unit) -> dict[str, Any]:
    """The token for JSON."""
    address = chain.xrt if token is None else await chain.tokens.address(token)
    return {"token": address, "symbol": unit.symbol, "decimals": unit.decimals}
