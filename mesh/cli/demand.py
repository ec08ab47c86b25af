"""`aira demand`: a person's side of the market."""

from __future__ import annotations

import asyncio
import shutil
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
import msgspec

from mesh.cli.options import with_settings
from mesh.errors import ConfigurationError, InputError
from mesh.running import run_to_end
from mesh.settings import CHAIN_SETTINGS, NETWORK_SETTINGS
from schemas import InvalidCid, parse_cid

if TYPE_CHECKING:
    from mesh.settings import Settings


@click.command("demand")
@click.option("--model", required=True, help="CID or ENS name of the behaviour that is wanted")
@click.option("--objective", required=True, help="file to play, or its CID")
@click.option(
    "--cost",
    type=click.IntRange(min=0),
    default=0,
    show_default=True,
    help="what it may cost, in the token's smallest unit (XRT: wn)",
)
@click.option(
    "--lifetime",
    type=click.IntRange(min=1),
    default=1000,
    show_default=True,
    help="blocks for which the demand is valid",
)
@click.option("--out", type=click.Path(path_type=Path), help="file to write the recording to")
@click.option("--json", "as_json", is_flag=True, help="print one JSON object at the end")
@with_settings(
    *NETWORK_SETTINGS,
    "lighthouse_contract",
    "erc20_token",
    "keyfile",
    "keyfile_password_file",
    *CHAIN_SETTINGS,
)
def command(settings: Settings, **order: Any) -> None:
    """Publish a Demand, wait for the contract, the work and the payment. Ctrl-C stops waiting; the contract goes on."""
    run_to_end(lambda: _demand(settings, **order))


async def _demand(
    settings: Settings, *, model: str, objective: str, cost: int, lifetime: int, out: Path | None, as_json: bool
) -> None:
    from mesh.agent import Agent

    say = (lambda text: None) if as_json else click.echo
    settings.keyfile_and_password()
    source = await asyncio.to_thread(_source, objective)
    if out is not None:
        await asyncio.to_thread(_check_writable, out)
    async with Agent(model, settings=settings) as agent:
        say(f"demand by {agent.address} for {model}")
        contract = await agent.demand(source, cost=cost, lifetime=lifetime)
        say(f"contract {contract.address} with {contract.liability.promisor}")
        outcome = await contract.outcome()
        say(f"{'paid' if outcome.success else 'refunded'}, result {outcome.result or 'none'}")
        if out is not None and outcome.result:
            recording = await contract.recording()
            await asyncio.to_thread(shutil.copyfile, recording, out)
            say(f"recording {out}")
    if as_json:
        facts = {"liability": contract.address, "success": outcome.success, "result": outcome.result}
        click.echo(msgspec.json.encode(facts))


def _source(objective: str) -> str | Path:
    """A file where there is one of that name, else a CID."""
    path = Path(objective)
    if path.is_file():
        return path
    try:
        parse_cid(objective)
    except InvalidCid:
        raise InputError(f"the objective {objective!r} is neither a file nor a CID") from None
    return objective


def _check_writable(out: Path) -> None:
    """Before anything is paid for, not after; leaves nothing behind."""
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        there = out.exists()
        with out.open("ab"):
            pass
        if not there:
            out.unlink()
    except OSError as error:
        raise ConfigurationError(f"can't write the recording to {out}: {error.strerror}") from None
