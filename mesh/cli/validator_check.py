"""`aira validator check`: judges a recording by hand."""

from __future__ import annotations

import asyncio
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Final

import click

from mesh.cli.errors import ProgramUnusable
from mesh.cli.files import FETCH_SETTINGS, fetch, file_or_cid, opened_store, require_readable
from mesh.cli.options import with_json, with_settings
from mesh.cli.output import print_json, progress
from mesh.cli.program import only, run_program
from mesh.cli.verify import exit_by_outcome, print_findings
from mesh.errors import InvalidAddress
from schemas import ZERO_ADDRESS, Liability, parse_address

if TYPE_CHECKING:
    from collections.abc import Mapping

    from mesh.content import Store
    from mesh.settings import Settings
    from mesh.validator.policy import Policy
    from schemas.model import ModelDescription

FILE: Final = click.Path(path_type=Path)
_HINT: Final = "write `validator = Validator(…)` in it, and its checks below"


@click.command("check")
@click.argument("recording", metavar="FILE|CID")
@click.option("--objective", type=FILE, help="file of the objective [fetched by the CID that the recording names]")
@click.option("--message", type=FILE, help="file with the Result message as it was sent (JSON)")
@click.option("--model", type=FILE, help="description of the model, with which the policy schema compares")
@click.option(
    "--policy", "policies", multiple=True, help="policy, such as acknowledged:within=2s; repeat it for several"
)
@click.option("--checks", type=FILE, help="Python program with a validator, whose policies and checks are applied, too")
@with_json
@with_settings(*FETCH_SETTINGS, "validator_policies")
def command(
    settings: Settings,
    recording: str,
    objective: Path | None,
    message: Path | None,
    model: Path | None,
    policies: tuple[str, ...],
    checks: Path | None,
    as_json: bool,
) -> None:
    """Apply a validator's policies to a recording, without a contract: those given by --policy, else those of the
    settings, and always `complete`.

    Checks that would compare the recording with a contract stay open. The exit code is 0 if no check fails, 1 if one
    fails, and 2 if the checks could not run.
    """
    asked = CheckedFiles(recording, objective, message, model, checks)
    exit_by_outcome(partial(check_recording, settings, asked, policies, as_json=as_json))


@dataclass(frozen=True)
class CheckedFiles:
    """The files that the options name; the recording may be a CID."""

    recording: str
    objective: Path | None = None
    message: Path | None = None
    model: Path | None = None
    checks: Path | None = None


async def check_recording(settings: Settings, files: CheckedFiles, policies: tuple[str, ...], *, as_json: bool) -> bool:
    """Print what the policies find in a recording. Returns whether all of it holds."""
    from mesh.validator.judging import examine

    chosen = await asyncio.to_thread(_policies, settings, policies, files.checks)
    model = None if files.model is None else await asyncio.to_thread(_description, files.model)
    message = None if files.message is None else await asyncio.to_thread(require_readable(files.message).read_bytes)
    async with opened_store(settings) as store:
        recording = await _file(settings, store, files.recording)
        about = await asyncio.to_thread(_about, recording, required=files.objective is None)
        objective = files.objective or await fetch(settings, store, about.get("objective", ""))
        with progress("checking") as tell:
            found = await asyncio.to_thread(
                examine,
                _liability_in(about),
                objective=require_readable(objective),
                recording=recording,
                policies=chosen,
                message=message,
                model=model,
                progress=tell,
            )
    holds = all(finding.holds is not False for finding in found)
    if as_json:
        print_json({"holds": holds, "policies": [policy.note for policy in chosen], "findings": found})
    else:
        print_findings([(finding.holds, f"{finding.policy}/{finding.code}", finding.detail) for finding in found])
    return holds


async def _file(settings: Settings, store: Store, name: str) -> Path:
    found = file_or_cid(name)
    return require_readable(found) if isinstance(found, Path) else await fetch(settings, store, found)


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
    """The policies to apply, each once. Raises `InvalidPolicy`, `ProgramUnusable`."""
    from mesh.validator.policies import COMPLETE, policy_of
    from mesh.validator.validator import Validator

    own: tuple[Policy, ...] = ()
    if program is not None:
        validator = only(run_program(require_readable(program), Validator), Validator, program, hint=_HINT)
        if validator is None:
            raise ProgramUnusable(f"{program} has no validator", hint=_HINT)
        own = validator.policies
    texts = named or (() if own else settings.validator_policies)
    return tuple(dict.fromkeys((COMPLETE, *map(policy_of, texts), *own)))


def _description(path: Path) -> ModelDescription:
    """The description of a model in a file. Raises `FileUnreadable`, `InvalidDescription`."""
    from schemas.model import MAX_MODEL_SIZE, parse_description

    with require_readable(path).open("rb") as file:
        return parse_description(file.read(MAX_MODEL_SIZE + 1))


def _liability_in(about: Mapping[str, str]) -> Liability:
    """The contract that a recording names, as far as it does."""
    return Liability(
        address=_address(about.get("liability", "")),
        model="",
        objective=about.get("objective", ""),
        result="",
        promisee=ZERO_ADDRESS,
        promisor=_address(about.get("agent", "")),
        lighthouse=_address(about.get("lighthouse", "")),
        lighthouse_fee=0,
        token=ZERO_ADDRESS,
        cost=0,
        validator=ZERO_ADDRESS,
        validator_fee=0,
        is_success=False,
        is_finalized=False,
    )


def _address(text: str) -> str:
    try:
        return parse_address(text)
    except InvalidAddress:
        return ZERO_ADDRESS
