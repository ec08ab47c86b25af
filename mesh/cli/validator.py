"""`aira validator`: judges results before they are paid; it also deploys contracts, collects fees and checks
recordings.
"""

from __future__ import annotations

import asyncio
from functools import partial
from typing import TYPE_CHECKING, Any, Final

import click

from mesh.amounts import ETH, XRT
from mesh.cli.chain_client import notice_when_slow, open_signing_chain
from mesh.cli.files import (
    FETCH_SETTINGS,
    fetch,
    file_of,
    opened_store,
    read_message,
    require_readable,
    required_description,
)
from mesh.cli.lazy import LazyGroup
from mesh.cli.options import ADDRESS, PATH, AmountText, with_json, with_settings, with_signing_settings
from mesh.cli.output import plural, print_facts, print_json, print_line, print_result, progress
from mesh.cli.program import only, run_program
from mesh.cli.verify import exit_by_outcome, print_findings
from mesh.errors import InputError, InvalidAddress
from mesh.settings import (
    AccountSettings,
    ChainSettings,
    ContentSettings,
    NetworkSettings,
    TelemetrySettings,
    ValidatorSettings,
)
from schemas import ZERO_ADDRESS, Liability, parse_address

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

    from mesh.settings import Settings
    from mesh.validator.policies import Policy


@click.group("validator", cls=LazyGroup, invoke_without_command=True)
@with_settings(
    NetworkSettings,
    "lighthouse_contract",
    ValidatorSettings,
    AccountSettings,
    ChainSettings,
    ContentSettings,
    "blocked_signers",
    TelemetrySettings,
)
def command(settings: Settings) -> None:
    """Judge the results of liabilities that name this validator, and sign what counts. Ctrl-C stops it.

    In generation 5 the validator is a contract (validator_contract) of which this account is a juror. In generation 3
    it is this account itself, which also needs ETH for gas.
    """
    if click.get_current_context().invoked_subcommand is None:
        from mesh.validator.validator import Validator

        Validator(settings=settings).run()


NEXT: Final = """
each juror runs:    aira validator --validator-contract {address}
promisees demand:   aira demand --validator {address} …
you collect fees:   aira validator collect {address}"""


@command.command("deploy", short_help="create a validator contract and name its jurors")
@click.option(
    "--juror",
    "jurors",
    multiple=True,
    type=ADDRESS,
    help="address or ENS name of an account that judges; repeat it for up to 7 [the settings' account]",
)
@click.option("--quorum", type=int, help="how many jurors must sign the same result [more than half of them]")
@with_json
@with_signing_settings()
async def deploy(settings: Settings, *, jurors: tuple[str, ...], quorum: int | None, as_json: bool) -> None:
    """Create a contract that demands of generation 5 can name as validator.

    A result counts when a quorum of its jurors has signed it. Jurors and quorum can't be changed later; with a new
    jury, deploy another contract. The settings' account pays the gas, and alone collects the fees.
    """
    async with open_signing_chain(settings) as chain:
        assert chain.account is not None
        keeper = chain.account.address
        named = jurors or (keeper,)
        with notice_when_slow():
            made = await chain.validators.deploy(named, len(named) // 2 + 1 if quorum is None else quorum)
    if as_json:
        facts = {"validator": made.address, "keeper": keeper, "jurors": made.jurors, "quorum": made.quorum}
        print_json(facts | {"tx": made.tx, "gas": made.gas_used, "wei": str(made.wei)})
        return
    print_facts(
        {
            "validator": made.address,
            "quorum": f"{made.quorum} of {plural(len(made.jurors), 'juror')}",
            "jurors": f"\n{'':11}".join(made.jurors),
        }
    )
    print_facts({"transaction": made.tx, "gas": f"{made.gas_used:,}, {ETH.show(made.wei)}"})
    print_line(NEXT.format(address=made.address))


@command.command("collect", short_help="pay out the fees of a validator contract")
@click.argument("contract", required=False, type=ADDRESS)
@click.option("--value", type=AmountText(), help="how much, in XRT (1.5) or wn (5wn) [all]")
@with_json
@with_signing_settings("validator_contract")
async def collect(settings: Settings, *, contract: str | None, value: str | None, as_json: bool) -> None:
    """Pay the fees that CONTRACT (by default that of the settings) has earned to the account that deployed it."""
    address = contract or settings.validator_contract
    if not address:
        raise InputError(
            "no validator contract is given", hint="give its address, or set validator_contract", code="invalid-options"
        )
    wanted = None if value is None else XRT.parse(value)
    async with open_signing_chain(settings) as chain:
        with notice_when_slow():
            paid = await chain.validators.collect(address, wanted)
        jury = await chain.validators.jury(address)
    left, gas = 0 if jury is None else jury.fees, f"{paid.gas_used:,}, {ETH.show(paid.wei)}"
    result = {"validator": jury.address if jury else address, "collected": str(paid.value), "left": str(left)}
    cost = {"tx": paid.tx, "gas": paid.gas_used, "wei": str(paid.wei)}
    facts = {"collected": XRT.show(paid.value), "left": XRT.show(left), "transaction": paid.tx, "gas": gas}
    print_result(result | cost, facts, as_json=as_json)


_HINT: Final = "write `validator = Validator(…)` in it, and its checks below"


@command.command("check", short_help="judge a recording by hand")
@click.argument("recording", metavar="FILE|CID")
@click.option("--objective", type=PATH, help="file of the objective [fetched by the CID that the recording names]")
@click.option("--message", type=PATH, help="file with the Result message as it was sent (JSON)")
@click.option("--model", help="model with a description, with which the policy schema compares: a file or a CID")
@click.option(
    "--policy", "policies", multiple=True, help="policy, such as acknowledged:within=2s; repeat it for several"
)
@click.option("--checks", type=PATH, help="Python program with a validator, whose policies and checks are applied, too")
@with_json
@with_settings(*FETCH_SETTINGS, "validator_policies", "validator_bags")
def check(settings: Settings, **options: Any) -> None:
    """Apply a validator's policies to a recording, without a contract: those given by --policy, else those of the
    settings, and always `complete`.

    Checks that would compare the recording with a contract stay open. The exit code is 0 if no check fails, 1 if one
    fails, and 2 if the checks could not run.
    """
    exit_by_outcome(partial(check_recording, settings, **options))


async def check_recording(
    settings: Settings,
    *,
    recording: str,
    objective: Path | None,
    message: Path | None,
    model: str | None,
    policies: tuple[str, ...],
    checks: Path | None,
    as_json: bool,
) -> bool:
    """Print what the policies find in a recording. Returns whether all of it holds."""
    from mesh.validator.judging import examine
    from mesh.validator.verification import JobFiles

    chosen = await asyncio.to_thread(_policies, settings, policies, checks)
    said = None if message is None else await asyncio.to_thread(read_message, message)
    async with opened_store(settings) as store:
        described = None if model is None else await file_of(settings, store, model)
        description = None if described is None else await asyncio.to_thread(required_description, described)
        path = await file_of(settings, store, recording)
        about = await asyncio.to_thread(_about, path, required=objective is None)
        objective = objective or await fetch(settings, store, about.get("objective", ""))
        with progress("checking") as tell:
            found = await asyncio.to_thread(
                examine,
                _liability_in(about),
                JobFiles(objective=require_readable(objective), result=path, message=said),
                policies=chosen,
                model=description,
                bags=settings.validator_bags,
                progress=tell,
            )
    holds = all(finding.holds is not False for finding in found)
    if as_json:
        print_json({"holds": holds, "policies": [policy.note for policy in chosen], "findings": found})
    else:
        print_findings([(finding.holds, f"{finding.policy}/{finding.code}", finding.detail) for finding in found])
    return holds


def _about(path: Path, *, required: bool) -> Mapping[str, str]:
    """The job that a recording names. Of an unreadable one, nothing; or raises `RecordingError` if it is `required`."""
    from mesh.recording import ABOUT, GENEROUS, RecordingError, open_objective

    try:
        return open_objective(path, GENEROUS).metadata.get(ABOUT, {})
    except RecordingError:
        if required:
            raise
        return {}


def _policies(settings: Settings, named: tuple[str, ...], program: Path | None) -> tuple[Policy, ...]:
    """The policies to apply, each once. Raises `ConfigurationError`, `InputError`."""
    from mesh.validator.policies import COMPLETE, policy_of
    from mesh.validator.validator import Validator

    own: tuple[Policy, ...] = ()
    if program is not None:
        validator = only(run_program(require_readable(program), Validator), Validator, program, hint=_HINT)
        if validator is None:
            raise InputError(f"{program} has no validator", hint=_HINT, code="program-unusable")
        own = validator.policies
    texts = named or (() if own else settings.validator_policies)
    return tuple(dict.fromkeys((COMPLETE, *map(policy_of, texts), *own)))


def _liability_in(about: Mapping[str, str]) -> Liability:
    """The contract that a recording names, as far as it does."""
    return Liability.of_nobody(
        address=_address(about.get("liability", "")),
        objective=about.get("objective", ""),
        promisor=_address(about.get("agent", "")),
        lighthouse=_address(about.get("lighthouse", "")),
    )


def _address(text: str) -> str:
    try:
        return parse_address(text)
    except InvalidAddress:
        return ZERO_ADDRESS
