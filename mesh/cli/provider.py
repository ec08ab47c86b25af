"""`aira provider`: matches the orders of a lighthouse and settles them on the chain."""

from __future__ import annotations

import asyncio
import logging
from contextlib import AsyncExitStack, asynccontextmanager
from functools import partial
from typing import TYPE_CHECKING

import click
from msgspec.structs import asdict

from mesh.base.background import Background
from mesh.base.log_context import LogSource, log_event
from mesh.cli.options import with_settings
from mesh.cli.output import announce
from mesh.role.running import open_when_ready, run_until_stopped, serve_on_each_chain, wait_for_files
from mesh.settings import AccountSettings, ChainSettings, NetworkSettings, TelemetrySettings
from mesh.telemetry.logs import set_process_source
from mesh.telemetry.serving import Telemetry

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable

    from mesh.chain import Account
    from mesh.market.provider import Earnings, Provider
    from mesh.network import Network
    from mesh.settings import Settings

log = logging.getLogger(__name__)


@click.command("provider")
@with_settings(
    NetworkSettings,
    "lighthouse_contract",
    AccountSettings,
    ChainSettings,
    "open_orders_limit",
    "unmined_limit",
    "free_contracts",
    "customers",
    "deadline_limit",
    "blocked_signers",
    TelemetrySettings,
)
def command(settings: Settings) -> None:
    """Match the demands and offers of a lighthouse, create liabilities and finalize them. Ctrl-C stops it.

    The account needs a stake at the lighthouse, and ETH for gas. Earnings and costs are logged every ten minutes and
    when it stops.
    """
    run_until_stopped(lambda: serve_on_each_chain(settings, serve), settings=settings, role="provider")


async def serve(settings: Settings) -> None:
    from mesh.role.composition import load_account

    lighthouse = settings.lighthouse_contract
    async with AsyncExitStack() as stack:
        telemetry = await stack.enter_async_context(Telemetry(settings.metrics_listen))
        await wait_for_files(settings)
        account = await asyncio.to_thread(load_account, settings)
        set_process_source(LogSource("provider", account.address, lighthouse.lower()))
        make = partial(_open_provider, settings, account, telemetry)
        network, provider = await open_when_ready(stack, settings, make, role="provider", on_wait=telemetry.starting)
        words = f"provider {provider.address} serves {lighthouse}, Zenoh id {network.id}"
        announce(log, "provider-started", words, provider=provider.address, zenoh=network.id)
        tasks = await stack.enter_async_context(Background())
        tasks.start(report_earnings(provider.earnings), "earnings")
        await provider.run()


@asynccontextmanager
async def _open_provider(
    settings: Settings, account: Account, telemetry: Telemetry
) -> AsyncIterator[tuple[Network, Provider]]:
    """The provider with its chain and network, and its metrics. Raises `AiraError` for what is not ready yet.

    While a rotation gives it a new key, it may start without a stake: that is moved to it once it is at work.
    """
    from mesh.market.provider import ProviderProcess, check_account, provider_of
    from mesh.network import Endpoints, Network
    from mesh.role.composition import chain_of
    from mesh.role.handover import check_not_retired, handovers_to, rotation_file

    check_not_retired(settings.state_directory, account.address)
    async with chain_of(settings, account) as chain:
        is_moving = rotation_file(settings.keyfile_and_password()[0]).exists()
        if not (is_moving and handovers_to(settings.state_directory, account.address)):
            await check_account(chain, settings.lighthouse_contract)
        async with (
            Network(Endpoints.from_settings(settings)) as network,
            await provider_of(settings, network.session, chain) as provider,
        ):
            process = ProviderProcess(network, chain, [provider])
            with telemetry.showing(measure=process.measure, health=process.health):
                yield network, provider


async def report_earnings(earnings: Callable[[], Earnings], *, interval: float = 600.0) -> None:
    """Log earnings and costs periodically (interval in seconds) if they have changed, and at the end."""
    reported = None
    try:
        while True:
            await asyncio.sleep(interval)
            if (now := earnings()) != reported:
                _log_earnings(now)
                reported = now
    finally:
        _log_earnings(earnings())


def _log_earnings(earnings: Earnings) -> None:
    fields = asdict(earnings) | {"rejected": sum(earnings.rejected.values())}
    log.info("%s", earnings, extra=log_event("earnings-reported", **fields))
