"""`aira verify`: checks a recording as evidence of a job."""

from __future__ import annotations

import asyncio
import sys
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Final, NoReturn

import click
import msgspec

from mesh.cli.chain_client import open_chain
from mesh.cli.errors import InvalidOptions
from mesh.cli.files import FETCH_SETTINGS, fetch, opened_store, require_readable
from mesh.cli.options import ADDRESS, with_json, with_settings
from mesh.cli.output import plural, print_facts, print_json, print_table, printable, progress
from mesh.errors import AiraError
from mesh.evidence import Claim, Verdict, check_end, verify
from mesh.running import report, run_to_end
from mesh.settings import ChainSettings, options_of
from schemas import parse_address

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Sequence

    from mesh.settings import Settings

FILE: Final = click.Path(path_type=Path)
MARKS: Final = {True: "holds", False: "FAILS", None: "open"}


@click.command("verify")
@click.argument("liability", required=False, type=ADDRESS)
@click.option("--objective", type=FILE, help="file of the objective [fetched by its CID]")
@click.option("--result", type=FILE, help="file of the recording [fetched by its CID]")
@click.option("--message", type=FILE, help="file with the Result message as it was sent (JSON)")
@click.option("--offline", is_flag=True, help="don't read the contract; the checks that need it stay open")
@with_json
@with_settings(*dict.fromkeys((*FETCH_SETTINGS, *options_of(ChainSettings))))
def command(
    settings: Settings,
    liability: str | None,
    objective: Path | None,
    result: Path | None,
    message: Path | None,
    offline: bool,
    as_json: bool,
) -> None:
    """Check the objective and the recording of LIABILITY (an address) against each other and against the contract: the
    CIDs of both files, the signature, and that the recording is complete, belongs to this job and plays the objective.

    Without LIABILITY, --objective and --result are required, and neither a chain nor a network is used.

    Each check holds, fails, or stays open for lack of information. Messages of the objective that are not in the
    recording fail it, unless the job is known to have ended without success. The exit code is 0 if no check fails, 1 if
    one fails, and 2 if the checks could not run.
    """
    files = VerifiedFiles(objective=objective, result=result, message=message)
    exit_by_outcome(partial(verify_job, settings, liability, files, offline=offline, as_json=as_json))


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


class VerifiedFiles(msgspec.Struct, frozen=True, kw_only=True):
    """The files that the options name."""

    objective: Path | None
    result: Path | None
    message: Path | None


async def verify_job(
    settings: Settings, liability: str | None, files: VerifiedFiles, *, offline: bool, as_json: bool
) -> bool:
    if (liability is None or offline) and None in (files.objective, files.result):
        raise InvalidOptions(
            "without a contract to read, both files are required", hint="give --objective and --result"
        )
    message = None if files.message is None else await asyncio.to_thread(require_readable(files.message).read_bytes)
    claim = await _claim(settings, liability, offline=offline)
    verdict = await _verdict(settings, claim, files, message)
    if as_json:
        print_json({"holds": verdict.holds, "claim": claim, "findings": verdict.findings})
    else:
        _print(claim, verdict)
    return verdict.holds


async def _claim(settings: Settings, liability: str | None, *, offline: bool) -> Claim:
    if liability is None:
        return Claim()
    if offline:
        return Claim(liability=parse_address(liability))
    async with open_chain(settings) as chain:
        return Claim.of_contract(await chain.liabilities.get(liability))


async def _verdict(settings: Settings, claim: Claim, files: VerifiedFiles, message: bytes | None) -> Verdict:
    if files.result is None and not claim.result:
        return Verdict((check_end(claim),))
    async with opened_store(settings) as store:
        objective = (
            require_readable(files.objective) if files.objective else await fetch(settings, store, claim.objective)
        )
        result = require_readable(files.result) if files.result else await fetch(settings, store, claim.result)
        with progress("verifying") as tell:
            return await asyncio.to_thread(
                verify,
                claim,
                objective=objective,
                result=result,
                message=message,
                objective_cid="" if files.objective else claim.objective,
                result_cid="" if files.result else claim.result,
                progress=tell,
            )


def _print(claim: Claim, verdict: Verdict) -> None:
    print_facts(
        {
            "liability": claim.liability or None,
            "promisor": claim.promisor or None,
            "objective": claim.objective or None,
            "result": claim.result or None,
        }
    )
    print_findings([(finding.holds, finding.name, finding.detail) for finding in verdict.findings])


def print_findings(findings: Sequence[tuple[bool | None, str, str]]) -> None:
    """Print what was found: whether it holds, the name of the check, and what it says."""
    print_table(("", "check", "found"), [(MARKS[holds], name, printable(detail)) for holds, name, detail in findings])
    failed = sum(holds is False for holds, _, _ in findings)
    unknown = sum(holds is None for holds, _, _ in findings)
    open_checks = f", {unknown} stayed open" if unknown else ""
    click.echo(f"{failed} of {plural(len(findings), 'check')} failed{open_checks}")
