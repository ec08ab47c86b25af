"""`aira quotes`: what the robots of a model want for a job, before it is ordered."""

from __future__ import annotations

import asyncio
from dataclasses import replace
from typing import TYPE_CHECKING

import click

from mesh.cli.files import model_named, objective_given, objective_of
from mesh.cli.options import with_json, with_objective, with_settings, with_timeout
from mesh.cli.output import format_duration, print_json, print_line, print_table, printable
from mesh.settings import AccountSettings, ChainSettings, NetworkSettings
from mesh.watching.robots import labelled
from schemas.decoding import decode_json

if TYPE_CHECKING:
    from collections.abc import Mapping

    from mesh.agent.agent import Messages
    from mesh.amounts import Unit
    from mesh.settings import Settings
    from schemas.rpc import Quote


@click.command("quotes")
@click.option("--model", required=True, help="model of the robots: its file, CID or ENS name")
@with_objective
@with_timeout()
@with_json
@with_settings(NetworkSettings, "lighthouse_contract", "erc20_token", AccountSettings, ChainSettings)
async def command(
    settings: Settings, model: str, objective: str | None, messages: Messages, timeout: float, as_json: bool
) -> None:
    """Ask the robots of a model what they want for a job, when they would begin, and how long it takes.

    The cheapest is listed first, of each token that robots want to be paid in; those that want the token of the
    settings come first. A robot that does not want the job says why. Nothing is ordered, and nobody is bound: `aira
    demand --robot NAME|ADDRESS|cheapest|first` orders.
    """
    from mesh.agent.agent import Agent

    named = await asyncio.to_thread(model_named, model)
    given = await asyncio.to_thread(objective_given, objective, messages)
    settings.keyfile_and_password()
    async with Agent(named.name, settings=replace(settings, metrics_listen="")) as agent:
        quotes = await agent.quotes(agent.model, await objective_of(agent, given), timeout=timeout)
        units = await agent.parts.chain.tokens.units(quote.token for quote in quotes if quote.token)
        names = {quote.agent: agent.parts.robots.name(quote.agent) for quote in quotes}
    if as_json:
        print_json({"quotes": [decode_json(quote.encode()) | {"name": names[quote.agent]} for quote in quotes]})
    elif quotes:
        offers = [(*_shown(quote, units), names[quote.agent], quote.agent) for quote in quotes if not quote.code]
        if offers:
            print_table(("cost", "begins", "takes", "name", "address"), offers)
        for quote in (quote for quote in quotes if quote.code):
            why = f"{printable(quote.detail)} ({printable(quote.code)})".lstrip()
            print_line(f"{labelled(quote.agent, names[quote.agent])} declines: {why}")
    else:
        print_line("no robot of this model answers")


def _shown(quote: Quote, units: Mapping[str, Unit]) -> tuple[str, str, str]:
    """What a robot wants, when it would begin, and how long it takes, for people."""
    begins = f"in {format_duration(round(quote.start * 1e9))}" if quote.start else "now"
    cost = units[quote.token].show(quote.cost)
    return cost, begins, format_duration(round(quote.seconds * 1e9)) if quote.seconds else "unknown"
