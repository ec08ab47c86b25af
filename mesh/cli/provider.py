"""`aira provider`: the role that brings orders together."""

from __future__ import annotations

import asyncio
import logging
from typing import TYPE_CHECKING, Final

import click

from mesh.background import Background
from mesh.cli.options import with_settings
from mesh.running import run_until_stopped
from mesh.settings import CHAIN_SETTINGS, NETWORK_SETTINGS

if TYPE_CHECKING:
    from collections.abc import Callable

    from mesh.market.provider import Earnings
    from mesh.settings import Settings

log = logging.getLogger(__name__)

REPORT: Final = 600.0
"""Seconds between two looks at what was earned."""


@click.command("provider")
@with_settings(
    *NETWORK_SETTINGS,
    "lighthouse_contract",
    "keyfile",
    "keyfile_password_file",
    *CHAIN_SETTINGS,
    "open_orders_limit",
)
def command(settings: Settings) -> None:
    """Match the demands and offers of a lighthouse, make their contracts, finalize them. Ctrl-C ends it.

    The account needs a stake at the lighthouse, and ETH for gas. What it earns and spends is logged every ten minutes
    and at the end.
    """
    run_until_stopped(lambda: _serve(settings))


async def _serve(settings: Settings) -> None:
    from mesh.agent.parts import chain_of, endpoints_of, load_account
    from mesh.market.provider import Provider
    from mesh.market.standing import check_standing
    from mesh.network import Network

    lighthouse = settings.lighthouse_contract
    account = await asyncio.to_thread(load_account, settings)
    async with chain_of(settings, account) as chain:
        await check_standing(chain, lighthouse)
        async with (
            Network(endpoints_of(settings)) as network,
            Provider(network.session, chain, lighthouse, limit=settings.open_orders_limit) as provider,
            Background() as tasks,
        ):
            click.echo(f"provider {provider.address} serves {lighthouse}, Zenoh id {network.id}")
            tasks.start(_report(provider.earnings), "earnings")
            await provider.run()


async def _report(earnings: Callable[[], Earnings]) -> None:
    """Log what the work brought in and has cost: now and then, where it has changed, and at the end."""
    told = None
    try:
        while True:
            await asyncio.sleep(REPORT)
            if (now := earnings()) != told:
                log.info("%s", now)
                told = now
    finally:
        log.info("%s", earnings())
