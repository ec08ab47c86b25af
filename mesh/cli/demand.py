"""`aira demand`: publishes a demand and waits until its liability has ended."""

from __future__ import annotations

import asyncio
import shutil
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from mesh.cli.amounts import AMOUNT, XRT
from mesh.cli.errors import FileUnwritable, InvalidOptions, JobNotDone, NotAFileOrCid, OutputFailed
from mesh.cli.existing_demand import take_existing, wait_for_contract
from mesh.cli.options import with_json, with_settings
from mesh.cli.output import print_json, print_line
from mesh.errors import AiraError
from mesh.running import run_to_end
from mesh.settings import ChainSettings, NetworkSettings, options_of
from schemas import InvalidCid, parse_cid

if TYPE_CHECKING:
    from mesh.agent import Agent, Contract
    from mesh.settings import Settings


class Amount(click.ParamType[str]):
    """An amount. Its syntax is checked here; its value depends on the token."""

    name = "amount"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> str:
        """Return the text. Fails for one that is not an amount."""
        if AMOUNT.fullmatch(str(value).strip()) is None:
            self.fail(
                f"{str(value)[:40]!r} is not an amount; write 1.5 for one and a half XRT, or 1500000wn", param, ctx
            )
        return str(value)


@click.command("demand")
@click.option("--model", required=True, help="CID or ENS name of the model: the behaviour that you order")
@click.option("--objective", required=True, help="objective to play: a file or a CID")
@click.option(
    "--cost",
    type=Amount(),
    default="0",
    show_default=True,
    help="what you pay: whole tokens (1.5), or the smallest unit (1500000000wn for XRT, 15units for other tokens)",
)
@click.option("--validator", default="", help="address or ENS name of the validator of the result [none]")
@click.option(
    "--validator-fee", type=Amount(), default="0", show_default=True, help="the validator's fee, in XRT (or wn)"
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
def command(settings: Settings, **order: Any) -> None:
    """Publish a demand and wait for the contract, the work and the payment. Ctrl-C stops waiting, but does not withdraw
    the demand (`aira order withdraw` does) or cancel the contract.

    A demand that was interrupted stays open until its deadline. If an equal one is open, the command asks what to do;
    without a terminal it needs --existing.

    The exit code is 1 if the work was not done and the cost was returned, or if the recording (--out) is not
    available. --json prints one object when the contract has ended; it has an `error` if the exit code is 1.
    """
    run_to_end(lambda: demand(settings, **order))


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

    settings.keyfile_and_password()
    source = await asyncio.to_thread(_file_or_cid, objective)
    fee = XRT.parse(validator_fee)
    if fee and not terms["validator"]:
        raise InvalidOptions("--validator-fee needs --validator", hint="give --validator, or omit the fee")
    if out is not None:
        await asyncio.to_thread(_check_writable, out)
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
    existing_one = await take_existing(agent, cid, existing, quiet=quiet, **terms)
    if existing_one is None:
        await check_balance(agent.parts.chain, unit, terms["cost"], token=agent.settings.erc20_token)
        existing_one = await agent.order(cid, **terms)
        if not quiet:
            print_line(f"posted {existing_one.hash}, valid until block {existing_one.deadline:,}")
    contract = await wait_for_contract(existing_one)
    if not quiet:
        print_line(f"contract {contract.address} with {contract.liability.promisor}")
    return contract


async def _wait_for_end(contract: Contract, out: Path | None, *, as_json: bool) -> None:
    """Wait for the end, fetch the recording, and print both. Then raises what failed."""
    outcome = await contract.outcome()
    facts: dict[str, Any] = {"liability": contract.address, "success": outcome.success, "result": outcome.result}
    if not as_json:
        print_line(f"{'paid' if outcome.success else 'refunded'}, result {outcome.result or 'none'}")
    failure: AiraError | None = None
    if not outcome.success:
        failure = JobNotDone(
            "the job was not done; the cost was returned", hint=_failure_hint(contract, outcome.result)
        )
        facts["error"] = str(failure)
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


def _failure_hint(contract: Contract, result: str) -> str:
    """Where to find the reason of a failure."""
    if result:
        return f"the recording may show why: `aira objective show {result}`"
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


def _file_or_cid(objective: str) -> str | Path:
    """The path of the file with that name if there is one, else the CID. Raises `NotAFileOrCid`."""
    path = Path(objective)
    if path.is_file():
        return path
    try:
        parse_cid(objective)
    except InvalidCid:
        raise NotAFileOrCid(f"the objective {objective!r} is neither a file nor a CID") from None
    return objective


def _check_writable(out: Path) -> None:
    """Check that a file can be written there, before anything is paid. Leaves no file behind."""
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        existed = out.exists()
        with out.open("ab"):
            pass
        if not existed:
            out.unlink()
    except OSError as error:
        raise FileUnwritable(f"can't write the recording to {out}: {error.strerror}") from None
