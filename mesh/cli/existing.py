"""What `aira demand` does when an equal demand of the account is open, or has become a contract."""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING, Any, Final

import click

from mesh.cli.errors import DemandExists
from mesh.cli.output import plural
from mesh.cli.waiting import answer_of

if TYPE_CHECKING:
    from mesh.agent import Agent, Contract, Order

CHOICES: Final = {
    "wait": "wait for it",
    "withdraw": "withdraw it, and post a new one",
    "new": "post another one beside it",
}


async def take_existing(
    agent: Agent, objective: str, existing: str | None, *, quiet: bool, lifetime: int | None = None, **terms: Any
) -> Order | Contract | None:
    """What to wait for instead of a new demand: the open one with these terms, or its contract. None: post a new one.

    `existing` is the choice; without one, the user is asked in a terminal. Raises `DemandExists` without a terminal.
    """
    demands, contract = await _equal(agent, objective, **terms)
    if demands:  # perhaps one became a contract while nothing of the account ran
        await agent.parts.chain_head.reached(await agent.parts.chain.block_number())
        demands, contract = await _equal(agent, objective, **terms)
    if others := len(agent.orders()) - len(demands):
        click.echo(f"this account also has {plural(others, 'other open order')}; see `aira order list`", err=True)
    if not demands and contract is None:
        return None
    for order in demands:
        click.echo(f"the equal demand {order.hash} is open until block {order.deadline:,}", err=True)
    if contract is not None:
        click.echo(f"an equal demand became the contract {contract.address}, which has not ended", err=True)
    if existing is None and (quiet or not sys.stdin.isatty()):
        choices = ", ".join(f"--existing {choice} ({meaning})" for choice, meaning in CHOICES.items())
        raise DemandExists("an equal demand is open; a second one would be paid too", hint=f"choose: {choices}")
    choice = existing or await answer_of(_ask)
    if choice == "wait":
        return contract or demands[0]
    for order in demands if choice == "withdraw" else ():
        await order.withdraw()
        click.echo(f"withdrew {order.hash}; a provider that is creating its contract now may still finish", err=True)
    return None


async def _equal(
    agent: Agent, objective: str, *, cost: int, validator: str = "", validator_fee: int
) -> tuple[list[Order], Contract | None]:
    """The open demands with these terms, and the latest contract of one if it has not ended."""
    from mesh.agent.terms import is_repeated
    from schemas import Demand, decode

    fields: dict[str, Any] = {"model": agent.model, "objective": objective, "cost": cost, "validator": validator}
    wanted = await agent.runtime.trader.writer.terms(**fields, token="", lifetime=1)

    def is_equal(message: object) -> bool:
        return isinstance(message, Demand) and is_repeated(message, wanted, validator_fee=validator_fee)

    contracts = await agent.parts.ledger.contracts("demand")
    latest = next((address for payload, address in contracts if is_equal(decode(payload))), "")
    demands = [order for order in agent.orders() if is_equal(order.message)]
    liabilities = agent.parts.chain.liabilities
    if not latest or not await liabilities.exists(latest) or (await liabilities.get(latest)).is_finalized:
        return demands, None
    return demands, await agent.contract(latest)


def _ask() -> str:
    click.echo("\n".join(f"  {choice}: {meaning}" for choice, meaning in CHOICES.items()), err=True)
    return str(click.prompt("what now?", type=click.Choice(list(CHOICES)), err=True))
