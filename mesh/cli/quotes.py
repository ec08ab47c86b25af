"""`aira quotes`: what the robots of a model want for a job, before it is ordered."""

from __future__ import annotations

import asyncio
from dataclasses import replace
from typing import TYPE_CHECKING

import click

from mesh.cli.files import file_or_cid, model_named
from mesh.cli.options import with_json, with_settings, with_timeout
from mesh.cli.output import format_duration, print_json, print_line, print_table, printable
from mesh.settings import AccountSettings, ChainSettings, NetworkSettings
from schemas.decoding import decode_json

if TYPE_CHECKING:
    from mesh.amounts import Unit
    from mesh.settings import Settings
    from schemas.rpc import Quote


@click.command("quotes")
@click.option("--model", required=True, help="model of the robots: its file, CID or ENS name")
@click.option("--objective", required=True, help="objective that they would play: a file or a CID")
@with_timeout()
@with_json
@with_settings(NetworkSettings, "lighthouse_contract", "erc20_token", AccountSettings, ChainSettings)
async def command(settings: Settings, model: str, objective: str, timeout: float, as_json: bool) -> None:
    """Ask the robots of a model what they want for a job, when they would begin, and how long it takes.

    The cheapest is listed first; a robot that does not want the job says why. Nothing is ordered, and nobody is bound:
    `aira demand --robot NAME|ADDRESS|cheapest|first` orders.
    """
    from mesh.agent.agent import Agent

    named = await asyncio.to_thread(model_named, model)
    settings.keyfile_and_password()
    source = await asyncio.to_thread(file_or_cid, objective)
    async with Agent(named.name, settings=replace(settings, metrics_listen="")) as agent:
        unit = await agent.parts.chain.tokens.unit(agent.settings.erc20_token)
        quotes = await agent.quotes(agent.model, source, timeout=timeout)
        names = {quote.agent: agent.parts.robots.name(quote.agent) for quote in quotes}
    if as_json:
        print_json({"quotes": [decode_json(quote.encode()) | {"name": names[quote.agent]} for quote in quotes]})
    elif quotes:
        rows = [(names[quote.agent], quote.agent, *_shown(quote, unit)) for quote in quotes]
        print_table(("name", "address", "cost", "begins", "takes"), rows)
    else:
        print_line("no robot of this model answers")


def _shown(quote: Quote, unit: Unit) -> tuple[str, str, str]:
    """What a quote says, for people."""
    if quote.code:
        return f"declines: {printable(quote.detail)} ({printable(quote.code)})", "", ""
    takes = format_duration(round(quote.seconds * 1e9)) if quote.seconds else "unknown"
    return unit.show(quote.cost), f"in {format_duration(round(quote.start * 1e9))}" if quote.start else "now", takes
