"""`aira demand`: publishes a demand and waits until its liability has ended."""

from __future__ import annotations

import asyncio
import json
import shutil
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import click

from mesh.agent.errors import OrderExpired
from mesh.amounts import XRT
from mesh.background import Background
from mesh.cli.amounts import AmountText
from mesh.cli.chain_client import check_balance
from mesh.cli.demand_validator import agreed_fee
from mesh.cli.errors import InvalidOptions, JobNotDone, OutputFailed
from mesh.cli.existing import take_existing
from mesh.cli.files import file_or_cid, require_model, require_readable, require_writable
from mesh.cli.options import ADDRESS, with_json, with_settings
from mesh.cli.order import withdraw_orders, withdrawal_lines
from mesh.cli.output import format_duration, plural, print_json, print_line, printable, progress, wait_for_broken_pipe
from mesh.cli.waiting import JobPrinter, print_connection_changes
from mesh.errors import AiraError
from mesh.settings import ChainSettings, NetworkSettings, options_of
from schemas.address import ZERO_ADDRESS

if TYPE_CHECKING:
    from mesh.agent import Agent, Contract, Order
    from mesh.recording import Objective
    from mesh.settings import Settings
HELD_TIMEOUT: Final = 3.0
"""Seconds in which somebody on the mesh may say that it has the objective."""
SILENCE: Final = 5.0
"""Seconds without an offer and a decline after which the command says who is present."""


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
    "--validator-fee", type=AmountText(), help="the validator's fee, in XRT (or wn) [what the validator announces]"
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
@click.option("--yes", "confirmed", is_flag=True, help="post the demand even if perhaps nobody judges the work")
@click.option("--out", type=click.Path(path_type=Path), help="file to copy the recording to")
@click.option(
    "--withdraw-on-exit", is_flag=True, help="withdraw the demand if the command is interrupted before the contract"
)
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
    """Publish a demand and wait for the contract, the work and the payment. The objective is checked first, as `aira
    objective check` does. What happens is printed as it happens: offers, robots that decline and why, the contract, the
    playback, the result. The recording is kept in the account's store, so that `aira verify` and `aira objective show`
    need no robot.

    Ctrl-C stops waiting, but does not withdraw the demand (--withdraw-on-exit or `aira order withdraw` does) or cancel
    the contract. A demand that was interrupted stays open until its deadline. If an equal one is open, the command asks
    what to do; without a terminal it needs --existing.

    With --validator, the command first says who judges the work and by which policies, what that costs, and what
    happens if nobody judges. If nobody answers as the validator, or wants a higher fee, it asks; without a terminal it
    needs --yes.

    The exit code is 1 if the work was not done and the cost was returned, or if --out can't be written. --json prints
    an object for each thing that happens, with its `kind`, and one when the contract has ended; that has an `error` if
    the exit code is 1.
    """
    await demand(settings, **order)


async def demand(
    settings: Settings,
    *,
    objective: str,
    validator_fee: str | None,
    out: Path | None,
    as_json: bool,
    confirmed: bool = False,
    existing: str | None = None,
    withdraw_on_exit: bool = False,
    **terms: Any,
) -> None:
    from mesh.agent import Agent

    require_model(terms["model"])
    settings.keyfile_and_password()
    source = await asyncio.to_thread(_source, objective)
    fee = None if validator_fee is None else XRT.parse(validator_fee)
    if fee and not terms["validator"]:
        raise InvalidOptions("--validator-fee needs --validator", hint="give --validator, or omit the fee")
    if out is not None:
        await asyncio.to_thread(require_writable, out)
    checked = await asyncio.to_thread(_check_objective, settings, source) if isinstance(source, Path) else None
    # A server with the same settings may run beside this and serve metrics at the same port.
    async with Agent(terms.pop("model"), settings=replace(settings, metrics_listen="")) as agent, Background() as tasks:
        unit = await agent.parts.chain.tokens.unit(agent.settings.erc20_token)
        with closing(JobPrinter(unit, as_json=as_json)) as printer:
            changes = print_connection_changes(agent.parts.network, before=printer.close)
            tasks.start(changes, "network losses")
            tasks.start(wait_for_broken_pipe(), "readers of stdout")
            printer.line(f"demand by {agent.address} for {agent.model}")
            cid = source if isinstance(source, str) else await agent.add(source)
            terms["cost"] = unit.parse(terms["cost"])
            fee = await agreed_fee(agent, cid, fee, confirmed=confirmed, as_json=as_json, **terms)
            terms["validator_fee"] = fee
            printer.awaited = "the validator" if terms["validator"] else printer.awaited
            order = await take_existing(agent, cid, existing, quiet=as_json, **terms)
            if order is None:
                await check_balance(agent.parts.chain, unit, terms["cost"], token=agent.settings.erc20_token)
                order = await _post(agent, cid, checked, printer, **terms)
            contract = await _contract(agent, order, printer, withdraw_on_exit=withdraw_on_exit)
            await _wait_for_end(agent, contract, printer, out)


def _check_objective(settings: Settings, path: Path) -> Objective:
    """Check a file as robots do. Raises `ObjectiveUnfit`."""
    from mesh.recording import Limits, preflight
    from mesh.work.objectives import ObjectiveUnfit

    limits = Limits(size=settings.objective_size_limit, expanded=settings.objective_expanded_limit)
    with progress(f"checking {path.name}") as tell:
        outcome = preflight(path, limits, progress=tell)
    if outcome.objective is None or not outcome.ok:
        raise ObjectiveUnfit(str(path), outcome.reason, printable(outcome.detail))
    return outcome.objective


async def _check_held(agent: Agent, cid: str) -> Objective | None:
    """Check the objective with a CID, if it is in the store or somebody has it; else warn. Raises `ObjectiveUnfit`."""
    parts = agent.parts
    if await asyncio.to_thread(parts.store.checked, cid) or await parts.exchange.is_held(cid, timeout=HELD_TIMEOUT):
        return await agent.examine(cid)
    warning = f"nobody here has the objective {cid}: no robot can offer before somebody serves it"
    click.echo(f"aira: {warning}; `aira objective add FILE` prints a file's CID", err=True)
    return None


async def _post(agent: Agent, cid: str, checked: Objective | None, printer: JobPrinter, **terms: Any) -> Order:
    """Publish the demand; first check its objective, unless that was done."""
    if (objective := checked or await _check_held(agent, cid)) is not None:
        size = f"{plural(objective.count, 'message')}, {format_duration(objective.duration_ns)}"
        facts = {"objective": cid, "messages": objective.count, "seconds": objective.duration_ns / 1e9}
        printer.line(f"objective {cid}: {size}", kind="objective", **facts)
    order = await agent.order(cid, **terms)
    until = f"valid until block {order.deadline:,}"
    printer.line(f"posted {order.hash}, {until}", kind="posted", order=order.hash, deadline=order.deadline)
    return order


async def _contract(agent: Agent, order: Order | Contract, printer: JobPrinter, *, withdraw_on_exit: bool) -> Contract:
    """Wait until an order is a contract. When that is interrupted, say what becomes of the order, or withdraw it."""
    from mesh.agent import Contract, Order, Progress

    if isinstance(order, Contract):
        printer(Progress(kind="contract", agent=order.liability.promisor, detail=order.address))
        return order
    try:
        async with Background() as tasks:
            tasks.start(_say_who_is_present(agent, printer), "silence")
            return await order.contract(on_progress=printer)
    except asyncio.CancelledError:
        if withdraw_on_exit and isinstance(order, Order):
            for line in withdrawal_lines(await withdraw_orders(agent.parts, [order], on_chain=False)):
                click.echo(line, err=True)
        else:
            click.echo(await _stays(agent, order), err=True)
        raise
    except OrderExpired:
        click.echo(printer.summary(), err=True)
        raise


async def _say_who_is_present(agent: Agent, printer: JobPrinter) -> None:
    """If no robot offers or declines for a while, say who is there to do so."""
    await asyncio.sleep(SILENCE)
    if printer.is_silent:
        present = {role: await agent.channel.present(role) for role in ("agent", "provider")}
        agents = [key for key in present["agent"] if key.agent != agent.address.lower()]
        who = f"{plural(len(agents), 'other agent')} and {plural(len(present['provider']), 'provider')} are present"
        click.echo(f"no robot has offered or declined yet; {who} on {agent.channel.lighthouse}", err=True)


async def _stays(agent: Agent, order: Order) -> str:
    """Until when an order stays open, and how to withdraw it."""
    until = f"the demand stays valid until block {order.deadline:,}"
    try:
        blocks = order.deadline - await agent.parts.chain.block_number()
        seconds = blocks * (await agent.parts.chain.node.heads.block_time(blocks) or 0)
    except AiraError:
        seconds = 0
    about = f", for about {plural(round(seconds / 60) or 1, 'minute')}" if seconds > 0 else ""
    return f"{until}{about}; withdraw it with `aira order withdraw {order.hash[:16]}`"


async def _wait_for_end(agent: Agent, contract: Contract, printer: JobPrinter, out: Path | None) -> None:
    """Wait for the end, keep the recording, and print both. Then raises what failed."""
    try:
        outcome = await contract.outcome(on_progress=printer)
    except asyncio.CancelledError:
        printer.close()
        goes_on = f"the contract goes on; `aira liability watch {contract.address}` waits for its end"
        click.echo(f"{goes_on}, `aira liability show` says from when the cost can be refunded", err=True)
        raise
    facts: dict[str, Any] = {"liability": contract.address, "success": outcome.success, "result": outcome.result}
    if contract.liability.validator != ZERO_ADDRESS:
        facts["reports"] = [json.loads(one.encode()) for one in outcome.reports]
    printer.close()
    printer.line(f"{'paid' if outcome.success else 'refunded'}, result {outcome.result or 'none'}")
    failure: AiraError | None = None
    if not outcome.success:
        why = f"{printable(outcome.reason)} ({outcome.code})" if outcome.reason else "nothing says why"
        hint = _failure_hint(contract, outcome.result)
        failure = JobNotDone(f"the job was not done: {why}; the cost was returned", hint=hint)
        facts |= {"error": str(failure), "reason": outcome.reason, "code": outcome.code}
    try:
        facts["recording"] = None if not outcome.result else str(await _keep_recording(contract, out))
    except AiraError as error:
        facts["recording"] = None
        if out is not None:
            failure, facts["error"] = error, str(error)
        elif outcome.success:
            later = f"`aira objective get {outcome.result}` fetches it when the robot is present"
            click.echo(f"aira: {error}\n      {later}", err=True)
    if printer.as_json:
        print_json(facts)
    elif facts["recording"]:
        print_line(f"recording {facts['recording']}")
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


async def _keep_recording(contract: Contract, out: Path | None) -> Path:
    """Where the recording is: in the account's store, or its copy. Raises `ContentError`, `OutputFailed`."""
    recording = await contract.recording()
    if out is None:
        return recording
    try:
        await asyncio.to_thread(shutil.copyfile, recording, out)
    except OSError as error:
        raise OutputFailed(
            f"can't write the recording to {out}: {error.strerror}", hint=f"the store has it: {recording}"
        ) from None
    return out
