"""`aira signer`: the process that has the key, and orders for programs what the policy of its owner allows."""

from __future__ import annotations

import asyncio
import logging
from contextlib import AsyncExitStack
from functools import partial
from typing import TYPE_CHECKING

import click

from mesh.cli.options import FILE, with_settings
from mesh.cli.output import announce
from mesh.role.running import open_when_ready, run_until_stopped, serve_on_each_chain, wait_for_files
from mesh.settings import AccountSettings, ChainSettings, NetworkSettings, TelemetrySettings

if TYPE_CHECKING:
    from pathlib import Path

    from mesh.settings import Settings

log = logging.getLogger(__name__)


@click.command("signer")
@click.option("--policy", required=True, type=FILE, help="file (TOML) that says what programs may order")
@with_settings(
    NetworkSettings,
    "lighthouse_contract",
    "erc20_token",
    AccountSettings,
    "blocked_signers",
    "objective_size_limit",
    "content_limit",
    "fetch_timeout",
    "deadline_limit",
    ChainSettings,
    TelemetrySettings,
)
def command(settings: Settings, policy: Path) -> None:
    """Order for programs, with the key of --keyfile, what the owner's policy allows. Ctrl-C stops it.

    Programs, such as `aira mcp`, reach it by the socket signer/door.sock in the data folder, and get no key. Only
    processes of the same user can. What needs a person's yes is allowed with `aira mcp approve`.
    """
    settings.keyfile_and_password()
    run_until_stopped(partial(serve, settings, policy), settings=settings, role="signer")


async def serve(settings: Settings, policy: Path) -> None:
    """Serve until cancelled, also when a development chain is started afresh."""
    await serve_on_each_chain(settings, partial(_serve, policy))


async def _serve(policy: Path, settings: Settings) -> None:
    from mesh.signer.service import Signer

    await wait_for_files(settings)
    async with AsyncExitStack() as stack:
        signer = await open_when_ready(stack, settings, partial(Signer, settings, policy), role="signer")
        words = f"signer      orders for {signer.agent.address}, policy {signer.policy.hash[:12]}"
        announce(log, "signer-started", words, account=signer.agent.address, policy=signer.policy.hash)
        await asyncio.Event().wait()
