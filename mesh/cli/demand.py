"""`aira demand`: publishes a demand and waits until its liability has ended."""

from __future__ import annotations

import asyncio
import shutil
import sys
import threading
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import click

from mesh.cli.amounts import XRT, AmountText
from mesh.cli.errors import DemandExists, InvalidOptions, JobNotDone, OutputFailed
from mesh.cli.files import file_or_cid, require_model, require_readable, require_writable
from mesh.cli.options import ADDRESS, with_json, with_settings
from mesh.cli.output import plural, print_json, print_line, printable
from mesh.errors import AiraError
from mesh.settings import ChainSettings, NetworkSettings, options_of

if TYPE_CHECKING:
    from mesh.agent import Agent, Contract, Order, Progress
    from mesh.settings import Settings

CHOICES: Final = {
    "wait": "wait for it",
    "withdraw": "withdraw it, and post a new one",
    "new": "post another one beside it",
}


@click.command("demand")
@click.option("--model", required=True, help="CID or ENS name of the model: the behaviour that you order")
@click.option("--objective", required=True, help="objective to play: a file or a CID")
@click.option(
    "--cost",
    type=AmountText(),
    default="0",
    show_default=True,
    help="what you pay: whole tokens (1.5), or the smallest unit (1500000000wn for XRT, 15units for other tokens)",
)
@click.option("--validator", type=ADDRESS, default="", help="address or ENS name of the validator of the result [none]")
@click.option(
    "--validator-fee", type=AmountText(), default="0", show_default=True, help="the validator's fee, in XRT (or wn)"
)
@click.option(
    "--lifetime",
    type=click.IntRange(min=1),
    help="number of blocks for which the demand is valid [about ten minutes]",
)
@click.option(
    "--existing",
    type=click.Choice(["wait", "withdraw", "new"]),
    help="what to do if an equal demand is open: wait for it, withdraw it first, or post another [ask]",
)
@click.option("--out", type=click.Path(path_type=Path), help="file to write the recording to")
@with_json
@with_settings(
    *options_of(NetworkSettings),
    "lighthouse_contract",
    "erc20_token",
    "keyfile",
    "keyfile_password_file",
    *options_of(ChainSettings),
)
async def command(settings: Settings, **order: Any) -> None:
    """Publish a demand and wait for the contract, the work and the payment. Ctrl-C stops waiting, but does not withdraw
    the demand (`aira order withdraw` does) or cancel the contract.

    A demand that was interrupted stays open until its deadline. If an equal one is open, the command asks what to do;
    without a terminal it needs --existing.

    The exit code is 1 if the work was not done and the cost was returned, or if the recording (--out) is not
    available. --json prints one object when the contract has ended; it has an `error` if the exit code is 1.
    """
    await demand(settings, **order)


async def demand(
    settings: Settings,
    *,
    objective: str,
    validator_fee: str,
    out: Path | None,
    as_json: bool,
    existing: str | None = None,
    **terms: Any,
) -> None:
    from mesh.agent import Agent

    require_model(terms["model"])
    settings.keyfile_and_password()
    source = await asyncio.to_thread(_source, objective)
    fee = XRT.parse(validator_fee)
    if fee and not terms["validator"]:
        raise InvalidOptions("--validator-fee needs --validator", hint="give --validator, or omit the fee")
    if out is not None:
        await asyncio.to_thread(require_writable, out)
    # A server with the same settings may run beside this and serve metrics at the same port.
    async with Agent(terms.pop("model"), settings=replace(settings, metrics_listen="")) as agent:
        contract = await _contract(agent, source, validator_fee=fee, existing=existing, quiet=as_json, **terms)
        await _wait_for_end(contract, out, as_json=as_json)


async def _contract(
    agent: Agent,
    source: str | Path,
    *,
    cost: str,
    validator_fee: int,
    existing: str | None,
    quiet: bool,
    **terms: Any,
) -> Contract:
    """Publish the demand, or take one that is open, and wait for its contract. Prints both unless `quiet`."""
    from mesh.cli.chain_client import check_balance, unit_of

    unit = await unit_of(agent.parts.chain, agent.settings.erc20_token)
    if not quiet:
        print_line(f"demand by {agent.address} for {agent.model}")
    cid = source if isinstance(source, str) else await agent.add(source)
    terms |= {"cost": unit.parse(cost), "validator_fee": validator_fee}
    existing_one = await _take_existing(agent, cid, existing, quiet=quiet, **terms)
    if existing_one is None:
        await check_balance(agent.parts.chain, unit, terms["cost"], token=agent.settings.erc20_token)
        existing_one = await agent.order(cid, **terms)
        if not quiet:
            print_line(f"posted {existing_one.hash}, valid until block {existing_one.deadline:,}")
    contract = await _wait_for_contract(existing_one)
    if not quiet:
        print_line(f"contract {contract.address} with {contract.liability.promisor}")
    return contract


async def _take_existing(
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
        also = f"{plural(others, 'other order')} of this account may become contracts"
        click.echo(f"{also}, and are sent again; see `aira order list`", err=True)
    if not demands and contract is None:
        return None
    for order in demands:
        click.echo(f"the equal demand {order.hash} is open until block {order.deadline:,}", err=True)
    if contract is not None:
        click.echo(f"an equal demand became the contract {contract.address}, which has not ended", err=True)
    if existing is None and (quiet or not sys.stdin.isatty()):
        choices = ", ".join(f"--existing {choice} ({meaning})" for choice, meaning in CHOICES.items())
        raise DemandExists("an equal demand is open; a second one would be paid too", hint=f"choose: {choices}")
    choice = existing or await _ask()
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
    from mesh.agent.orders import is_repeated
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


async def _ask() -> str:
    """Ask in the terminal what to do, in a thread that does not keep an interrupted program alive."""
    loop = asyncio.get_running_loop()
    answer: asyncio.Future[str] = loop.create_future()

    def ask() -> None:
        click.echo("\n".join(f"  {choice}: {meaning}" for choice, meaning in CHOICES.items()), err=True)
        try:
            given = click.prompt("what now?", type=click.Choice(list(CHOICES)), err=True)
        except click.Abort:
            loop.call_soon_threadsafe(answer.cancel)
        else:
            loop.call_soon_threadsafe(answer.set_result, given)

    threading.Thread(target=ask, name="prompt", daemon=True).start()
    return await answer


async def _wait_for_contract(order: Order | Contract) -> Contract:
    """Wait until an order is a contract. Prints which providers can't use it meanwhile."""
    from mesh.agent import Contract

    if isinstance(order, Contract):
        return order
    withdraw = f"withdraw it with `aira order withdraw {order.hash[:16]}`"
    stays = f"the demand stays valid until block {order.deadline:,}; {withdraw}"

    def report(progress: Progress) -> None:
        if progress.kind == "rejected":
            why = f"{progress.detail} ({progress.code})"
            click.echo(f"provider {progress.agent} can't use the demand now: {why}\n{stays}", err=True)

    try:
        return await order.contract(on_progress=report)
    except asyncio.CancelledError:
        click.echo(stays, err=True)
        raise


async def _wait_for_end(contract: Contract, out: Path | None, *, as_json: bool) -> None:
    """Wait for the end, fetch the recording, and print both. Then raises what failed."""
    outcome = await contract.outcome()
    facts: dict[str, Any] = {"liability": contract.address, "success": outcome.success, "result": outcome.result}
    if not as_json:
        print_line(f"{'paid' if outcome.success else 'refunded'}, result {outcome.result or 'none'}")
    failure: AiraError | None = None
    if not outcome.success:
        why = f"{printable(outcome.reason)} ({outcome.code})" if outcome.reason else "nothing says why"
        hint = _failure_hint(contract, outcome.result)
        failure = JobNotDone(f"the job was not done: {why}; the cost was returned", hint=hint)
        facts |= {"error": str(failure), "reason": outcome.reason, "code": outcome.code}
    if out is not None:
        facts["recording"] = None
        try:
            if outcome.result:
                await _save_recording(contract, out)
                facts["recording"] = str(out)
        except AiraError as error:
            failure, facts["error"] = error, str(error)
    if as_json:
        print_json(facts)
    elif facts.get("recording"):
        print_line(f"recording {out}")
    if failure is not None:
        raise failure


def _source(objective: str) -> str | Path:
    """The file with that name if there is one, else the CID. Raises `NotAFileOrCid`, `FileUnreadable`."""
    source = file_or_cid(objective)
    return require_readable(source) if isinstance(source, Path) else source


def _failure_hint(contract: Contract, result: str) -> str:
    """Where to find the reason of a failure."""
    if result:
        return f"the recording shows more: `aira objective show {result}`"
    return f"it ended without a result; see `aira liability show {contract.address}`"


async def _save_recording(contract: Contract, out: Path) -> None:
    """Write the recording to a file. Raises `ContentError` if it can't be fetched, `OutputFailed` if not written."""
    recording = await contract.recording()
    try:
        await asyncio.to_thread(shutil.copyfile, recording, out)
    except OSError as error:
        raise OutputFailed(
            f"can't write the recording to {out}: {error.strerror}", hint=f"the store has it: {recording}"
        ) from None
