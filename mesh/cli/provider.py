"""`aira provider`: the role that brings orders together."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

import click

from mesh.cli.options import with_settings
from mesh.running import run_until_stopped

if TYPE_CHECKING:
    from mesh.settings import Settings


@click.command("provider")
@with_settings(
    "connect",
    "web3_http_provider",
    "ens_contract",
    "factory_contract",
    "lighthouse_contract",
    "keyfile",
    "keyfile_password_file",
    "poll_interval",
    "open_orders_limit",
)
def command(settings: Settings) -> None:
    """Match the demands and offers of a lighthouse, make their contracts, finalize them. Ctrl-C ends it.

    The account needs a stake at the lighthouse.
    """
    run_until_stopped(lambda: _serve(settings))


async def _serve(settings: Settings) -> None:
    from mesh.agent.parts import chain_of, endpoints_of, load_account
    from mesh.market.provider import Provider
    from mesh.network import Network

    account = await asyncio.to_thread(load_account, settings)
    async with (
        chain_of(settings, account) as chain,
        Network(endpoints_of(settings)) as network,
        Provider(network.session, chain, settings.lighthouse_contract, limit=settings.open_orders_limit) as provider,
    ):
        click.echo(f"provider {provider.address} serves {settings.lighthouse_contract}, Zenoh id {network.id}")
        await provider.run()
