"""`aira validator`: judges results before they are paid; it also deploys contracts, collects fees and checks
recordings. `aira verify`: checks a recording against its objective and its liability.
"""

from __future__ import annotations

import asyncio
import sys
from contextlib import asynccontextmanager
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any, Final, NoReturn

import click

from mesh.amounts import ETH, XRT
from mesh.cli import LazyGroup
from mesh.cli.chain_client import notice_when_slow, open_chain, open_signing_chain
from mesh.cli.files import (
    FETCH_SETTINGS,
    fetch,
    file_of,
    only,
    opened_store,
    read_message,
    require_readable,
    required_description,
    run_program,
)
from mesh.cli.options import ADDRESS, PATH, AmountText, with_json, with_settings, with_signing_settings
from mesh.cli.output import (
    plural,
    print_facts,
    print_json,
    print_line,
    print_result,
    print_table,
    printable,
    progress,
    short_address,
)
from mesh.errors import AiraError, InputError, InvalidAddress
from mesh.role.running import report, run_to_end
from mesh.settings import (
    AccountSettings,
    ChainSettings,
    ContentSettings,
    NetworkSettings,
    TelemetrySettings,
    ValidatorSettings,
)
from mesh.validator.verification import Claim, JobFiles, Verdict, check_end, verify
from schemas import ZERO_ADDRESS, Liability, parse_address
from schemas.decoding import decode_json

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Awaitable, Callable, Mapping, Sequence
    from pathlib import Path

    from mesh.chain import Chain
    from mesh.network import Network
    from mesh.settings import Settings
    from mesh.validator.judging import Policy
    from schemas.verdicts import ValidatorReport


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
    from mesh.validator.judging import COMPLETE, policy_of
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


CONNECT_TIMEOUT: Final = 3.0
"""Seconds to connect to a router."""


async def reports_on(settings: Settings, chain: Chain, liability: Liability) -> Sequence[ValidatorReport] | None:
    """The verified reports of the jurors that answer; None if the mesh can't be asked, which is printed to stderr."""
    if liability.validator == ZERO_ADDRESS:
        return ()
    try:
        async with _network(settings) as network:
            return await _ask(network, settings, chain, liability)
    except AiraError as error:
        click.echo(f"aira: the validator's reports are not known: {error}", err=True)
        return None


def verdict_facts(reports: Sequence[ValidatorReport]) -> dict[str, str | None]:
    """Each juror's verdict, for people."""
    from mesh.agent.contracts import verdict_words

    return {f"juror {short_address(one.juror)}": printable(verdict_words(one)) for one in reports}


def reports_json(reports: Sequence[ValidatorReport] | None) -> list[Any] | None:
    """Reports for JSON: as they are on the wire."""
    return None if reports is None else [decode_json(one.encode()) for one in reports]


async def print_verdicts(settings: Settings, chain: Chain, liability: Liability) -> None:
    """Print each juror's verdict on an open liability when it is there, until cancelled."""
    from mesh.agent.contracts import verdict_words

    if liability.validator == ZERO_ADDRESS:
        return
    said: set[str] = set()
    try:
        jury = await chain.validators.jury(liability.validator)
        needed = plural(1 if jury is None else jury.quorum, "juror")
        print_line(f"its validator {liability.validator} must judge the result: {needed} alike")
        async with _network(settings) as network:
            while True:
                for one in await _ask(network, settings, chain, liability):
                    if one.juror not in said:
                        said.add(one.juror)
                        print_line(f"juror {one.juror} judged: {printable(verdict_words(one))}")
                await asyncio.sleep(5)
    except AiraError as error:
        click.echo(f"aira: the validator's reports are not known: {error}", err=True)


@asynccontextmanager
async def _network(settings: Settings) -> AsyncIterator[Network]:
    from mesh.network import Endpoints, Network

    quick = replace(settings, connect_timeout=min(settings.connect_timeout, CONNECT_TIMEOUT))
    async with Network(Endpoints.from_settings(quick)) as network:
        yield network


async def _ask(network: Network, settings: Settings, chain: Chain, liability: Liability) -> Sequence[ValidatorReport]:
    from mesh.agent.contracts import asked_reports

    lighthouse, timeout = settings.lighthouse_contract.lower(), settings.answer_timeout
    return await asked_reports(network.session, lighthouse, chain, liability, timeout=timeout)


MARKS: Final = {True: "holds", False: "FAILS", None: "open"}


@click.command("verify")
@click.argument("liability", required=False, type=ADDRESS)
@click.option("--objective", type=PATH, help="file of the objective [fetched by its CID]")
@click.option("--result", type=PATH, help="file of the recording [fetched by its CID]")
@click.option("--message", type=PATH, help="file with the Result message as it was sent (JSON)")
@click.option("--offline", is_flag=True, help="don't read the contract; the checks that need it stay open")
@with_json
@with_settings(*FETCH_SETTINGS, ChainSettings)
def verify_recording(settings: Settings, **options: Any) -> None:
    """Check the objective and the recording of LIABILITY (an address) against each other and against the contract: the
    CIDs of both files, the signature, and that the recording is complete, belongs to this job and plays the objective.

    Without LIABILITY, --objective and --result are required, and neither a chain nor a network is used.

    Each check holds, fails, or stays open for lack of information. Messages of the objective that are not in the
    recording fail it, unless the job is known to have ended without success. The exit code is 0 if no check fails, 1 if
    one fails, and 2 if the checks could not run.
    """
    exit_by_outcome(partial(verify_job, settings, **options))


def exit_by_outcome(check: Callable[[], Awaitable[bool]]) -> NoReturn:
    """Exit with 0 if the check holds, with 1 if it does not, and with 2 if it could not run."""
    exit_code = 0

    async def main() -> None:
        nonlocal exit_code
        try:
            exit_code = 0 if await check() else 1
        except AiraError as error:  # of any kind: exit code 1 means that a check failed
            report(error)
            exit_code = 2

    run_to_end(main)
    sys.exit(exit_code)


async def verify_job(
    settings: Settings,
    *,
    liability: str | None,
    objective: Path | None,
    result: Path | None,
    message: Path | None,
    offline: bool,
    as_json: bool,
) -> bool:
    if (liability is None or offline) and (objective is None or result is None):
        raise InputError(
            "without a contract to read, both files are required",
            hint="give --objective and --result",
            code="invalid-options",
        )
    said = None if message is None else await asyncio.to_thread(read_message, message)
    claim = await _claim(settings, liability, offline=offline)
    verdict = await _verdict(settings, claim, objective, result, said)
    if as_json:
        print_json({"holds": verdict.holds, "claim": claim, "findings": verdict.findings})
    else:
        named = ("liability", "promisor", "objective", "result")
        print_facts({name: getattr(claim, name) or None for name in named})
        print_findings([(finding.holds, finding.name, finding.detail) for finding in verdict.findings])
    return verdict.holds


async def _claim(settings: Settings, liability: str | None, *, offline: bool) -> Claim:
    if liability is None:
        return Claim()
    if offline:
        return Claim(liability=parse_address(liability))
    async with open_chain(settings) as chain:
        return Claim.of_contract(await chain.liabilities.get(liability))


async def _verdict(
    settings: Settings, claim: Claim, objective: Path | None, result: Path | None, message: bytes | None
) -> Verdict:
    if result is None and not claim.result:
        return Verdict((check_end(claim),))
    async with opened_store(settings) as store:
        played = require_readable(objective) if objective else await fetch(settings, store, claim.objective)
        recorded = require_readable(result) if result else await fetch(settings, store, claim.result)
        files = JobFiles(
            objective=played,
            result=recorded,
            message=message,
            objective_cid="" if objective else claim.objective,
            result_cid="" if result else claim.result,
        )
        with progress("verifying") as tell:
            return await asyncio.to_thread(verify, claim, files, bags=True, progress=tell)


def print_findings(findings: Sequence[tuple[bool | None, str, str]]) -> None:
    """Print what was found: whether it holds, the name of the check, and what it says."""
    print_table(("", "check", "found"), [(MARKS[holds], name, printable(detail)) for holds, name, detail in findings])
    failed = sum(holds is False for holds, _, _ in findings)
    unknown = sum(holds is None for holds, _, _ in findings)
    open_checks = f", {unknown} stayed open" if unknown else ""
    click.echo(f"{failed} of {plural(len(findings), 'check')} failed{open_checks}")
