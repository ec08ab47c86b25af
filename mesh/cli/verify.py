"""`aira verify`: checks a recording against its objective and its liability, and prints the verdict of each check."""

from __future__ import annotations

import asyncio
import sys
from contextlib import asynccontextmanager
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any, Final, NoReturn

import click

from mesh.cli.chain_client import open_chain
from mesh.cli.files import FETCH_SETTINGS, fetch, opened_store, read_message, require_readable
from mesh.cli.options import ADDRESS, PATH, with_json, with_settings
from mesh.cli.output import plural, print_facts, print_json, print_line, print_table, printable, progress, short_address
from mesh.errors import AiraError, InputError
from mesh.role.running import report, run_to_end
from mesh.settings import ChainSettings
from mesh.validator.verification import Claim, JobFiles, Verdict, check_end, verify
from schemas import parse_address
from schemas.address import ZERO_ADDRESS
from schemas.decoding import decode_json

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Awaitable, Callable, Sequence
    from pathlib import Path

    from mesh.chain import Chain
    from mesh.network import Network
    from mesh.settings import Settings
    from schemas import Liability
    from schemas.verdicts import ValidatorReport


CONNECT_TIMEOUT: Final = 3.0
"""Seconds to connect to a router."""
INTERVAL: Final = 5.0
"""Seconds between two questions for new reports."""


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
                await asyncio.sleep(INTERVAL)
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
def command(settings: Settings, **options: Any) -> None:
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
