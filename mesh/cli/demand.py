"""`aira demand`: a person's side of the market."""

from __future__ import annotations

import asyncio
import shutil
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from mesh.cli.amounts import AMOUNT, XRT
from mesh.cli.options import with_json, with_settings
from mesh.cli.output import print_json, print_line
from mesh.errors import AiraError, ConfigurationError, InputError, RemoteError
from mesh.running import run_to_end
from mesh.settings import ChainSettings, NetworkSettings, options_of
from schemas import InvalidCid, parse_cid

if TYPE_CHECKING:
    from mesh.agent import Agent, Contract
    from mesh.settings import Settings


class Amount(click.ParamType[str]):
    """An amount as people write it. What is none is refused at once; how much it is depends on the token."""

    name = "amount"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> str:
        """The same text."""
        if AMOUNT.fullmatch(str(value).strip()) is None:
            self.fail(
                f"{str(value)[:40]!r} is not an amount; write 1.5 for one and a half XRT, or 1500000wn", param, ctx
            )
        return str(value)


@click.command("demand")
@click.option("--model", required=True, help="CID or ENS name of the behaviour that is wanted")
@click.option("--objective", required=True, help="file to play, or its CID")
@click.option(
    "--cost",
    type=Amount(),
    default="0",
    show_default=True,
    help="what it may cost: 1.5 counts whole tokens (XRT), 1500000000wn (units for other tokens) the smallest unit",
)
@click.option("--validator", default="", help="address or ENS name of who is to judge the result [nobody]")
@click.option(
    "--validator-fee", type=Amount(), default="0", show_default=True, help="what the validator gets, in XRT (or wn)"
)
@click.option(
    "--lifetime",
    type=click.IntRange(min=1),
    default=1000,
    show_default=True,
    help="blocks for which the demand is valid",
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
    """Publish a Demand, wait for the contract, the work and the payment. Ctrl-C stops waiting; the contract goes on.

    The exit code is 1 when it was not done and the money came back, and when the recording (--out) can't be had.
    With --json one object is printed when the contract has ended, whichever way; it has an `error` if the code is 1.
    """
    run_to_end(lambda: _demand(settings, **order))


async def _demand(
    settings: Settings, *, objective: str, validator_fee: str, out: Path | None, as_json: bool, **terms: Any
) -> None:
    from mesh.agent import Agent

    settings.keyfile_and_password()
    source = await asyncio.to_thread(_source, objective)
    fee = XRT.parse(validator_fee)
    if fee and not terms["validator"]:
        raise InputError("a validator's fee without a validator", hint="name the validator with --validator")
    if out is not None:
        await asyncio.to_thread(_check_writable, out)
    # Metrics are a server's, and one may run beside this with the same settings.
    async with Agent(terms.pop("model"), settings=replace(settings, metrics_listen="")) as agent:
        contract = await _contract(agent, source, validator_fee=fee, quiet=as_json, **terms)
        await _ending(contract, out, as_json=as_json)


async def _contract(
    agent: Agent, source: str | Path, *, cost: str, validator_fee: int, quiet: bool, **terms: Any
) -> Contract:
    """The contract that comes of the demand; what may be said is said."""
    from mesh.cli.chain_client import check_balance, unit_of

    chain, token = agent.parts.chain, agent.settings.erc20_token
    unit = await unit_of(chain, token)
    amount = unit.parse(cost)
    if not quiet:
        print_line(f"demand by {agent.address} for {agent.model}")
    await check_balance(chain, unit, amount, token=token)
    contract = await agent.demand(source, cost=amount, validator_fee=validator_fee, **terms)
    if not quiet:
        print_line(f"contract {contract.address} with {contract.liability.promisor}")
    return contract


async def _ending(contract: Contract, out: Path | None, *, as_json: bool) -> None:
    """Wait for the end, fetch the recording, and tell of both. Raises why there is none after telling the end."""
    outcome = await contract.outcome()
    facts: dict[str, Any] = {"liability": contract.address, "success": outcome.success, "result": outcome.result}
    if not as_json:
        print_line(f"{'paid' if outcome.success else 'refunded'}, result {outcome.result or 'none'}")
    failure: AiraError | None = None
    if not outcome.success:
        failure = RemoteError("the job was not done, and its cost came back", hint=_why(contract, outcome.result))
        facts["error"] = str(failure)
    if out is not None:
        facts["recording"] = None
        try:
            if outcome.result:
                await _keep(contract, out)
                facts["recording"] = str(out)
        except AiraError as error:
            failure, facts["error"] = error, str(error)
    if as_json:
        print_json(facts)
    elif facts.get("recording"):
        print_line(f"recording {out}")
    if failure is not None:
        raise failure


def _why(contract: Contract, result: str) -> str:
    """Where to look for the reason."""
    if result:
        return f"its recording may say why: aira objective show {result}"
    return f"it ended without a result: aira liability show {contract.address}"


async def _keep(contract: Contract, out: Path) -> None:
    """Write the recording to a file. Raises a `ContentError` when it can't be had, `AiraError` when not written."""
    recording = await contract.recording()
    try:
        await asyncio.to_thread(shutil.copyfile, recording, out)
    except OSError as error:
        raise AiraError(
            f"can't write the recording to {out}: {error.strerror}", hint=f"it was fetched, and is in {recording}"
        ) from None


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
