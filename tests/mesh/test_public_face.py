"""What users import from `mesh`: that it is complete, light, and typed, so that mypy finds wrong handlers."""

from __future__ import annotations

import subprocess
import sys
from importlib import import_module
from pathlib import Path

import pytest
from mypy import api

from mesh import AiraError

ROOT = Path(__file__).parents[2]

GOOD = """
from msgspec import Struct

from mesh import (
    Agent,
    AiraError,
    Contract,
    Declined,
    Demand,
    Empty,
    Job,
    JobFailed,
    Liability,
    Offer,
    Outcome,
    Phase,
    Result,
    Settings,
    String,
    ValidatorReport,
    Verified,
    __version__,
)


class Move(Struct):
    metres: float


agent = Agent(model="QmTH8nmTYpLtoMXvrkG18CeKBcT926SBYLCTjiGmvtLE82", settings=Settings())


@agent.on_demand
async def offer(demand: Verified[Demand]) -> None:
    validator = await agent.validator(demand)
    if validator is not None and (not validator.has_quorum or "rate" in [one.name for one in validator.policies]):
        raise Declined("validator", validator.title)
    await agent.offer(demand)


@agent.on_report
async def judged(report: ValidatorReport) -> None:
    print(report.success, [finding.detail for finding in report.failures])


@agent.on("/blink")
async def blink(job: Job, message: object) -> None:
    if job.position > 10 or "/blink" not in job.topics:
        raise JobFailed(f"too many blinks in {job.liability.address}")
    job.publish("/led", "done")


@agent.on("/go", Move)
async def go(job: Job, move: Move) -> str:
    return f"{move.metres} m"


@agent.on("/stop", kind=Empty)
async def stop(job: Job, nothing: Empty) -> None:
    print(__version__)


@agent.on("/turn")
def turn(job: Job, radians: float) -> None:
    print(radians / 2)


@agent.on("*")
async def anything(job: Job, message: String) -> None:
    print(message.data)


@agent.on_offer
async def on_offer(offer: Verified[Offer]) -> None:
    print(offer.message.cost)


@agent.on_result
async def on_result(result: Verified[Result]) -> None:
    print(result.message.liability)


@agent.on_liability
async def on_liability(phase: Phase, liability: Liability) -> None:
    print(phase.value, liability.cost)


@agent.every(5.0)
def tick() -> None:
    print("tick")


async def trade() -> Outcome:
    try:
        contract: Contract = await agent.demand("QmTH8nmTYpLtoMXvrkG18CeKBcT926SBYLCTjiGmvtLE82", cost=1)
    except AiraError as error:
        print(error.code)
        raise
    outcome = await contract.outcome()
    print((await agent.validator(contract.liability.validator)).fee, outcome.reports, await contract.reports())
    return outcome


if __name__ == "__main__":
    agent.run()
"""

START = """
from msgspec import Struct

from mesh import Agent, Demand, Job, Liability, Offer, Phase, String, Verified

agent = Agent()


class Move(Struct):
    metres: float

"""

BAD = {
    "another_kind": ("@agent.on('/go', kind=Move)\nasync def go(job: Job, move: String) -> None: ...", "arg-type"),
    "no_job": ("@agent.on('/go')\nasync def go(message: object) -> None: ...", "type-var"),
    "sync_another_kind": ("@agent.on('/go', Move)\ndef go(job: Job, move: float) -> None: ...", "arg-type"),
    "sync_no_job": ("@agent.on('/go')\ndef go(message: float) -> None: ...", "type-var"),
    "offer_for_demand": ("@agent.on_demand\nasync def f(offer: Verified[Offer]) -> None: ...", "type-var"),
    "unverified": ("@agent.on_demand\nasync def f(demand: Demand) -> None: ...", "type-var"),
    "swapped": ("@agent.on_liability\nasync def f(liability: Liability, phase: Phase) -> None: ...", "type-var"),
    "arguments": ("@agent.every(1.0)\nasync def f(seconds: float) -> None: ...", "type-var"),
    "report_of_result": ("@agent.on_report\nasync def f(result: Verified[Offer]) -> None: ...", "type-var"),
    "no_validator": ("async def fee(d: Demand) -> int:\n    return (await agent.validator(d)).fee", "union-attr"),
    "private": ("@agent.on('/go')\nasync def go(job: Job, m: object) -> None:\n    job.close()", "attr-defined"),
    "missing_name": ("from mesh import Nothing", "attr-defined"),
}


@pytest.fixture(scope="module")
def mypy_errors(tmp_path_factory: pytest.TempPathFactory) -> dict[str, list[str]]:
    """The error codes that mypy --strict gives each of these programs, in one run."""
    folder = tmp_path_factory.mktemp("programs")
    programs = {"good": GOOD} | {name: START + program + "\n" for name, (program, _) in BAD.items()}
    for name, program in programs.items():
        (folder / f"{name}.py").write_text(program)
    files = [str(folder / f"{name}.py") for name in programs]
    config = ("--config-file", str(ROOT / "pyproject.toml"), "--cache-dir", str(ROOT / ".mypy_cache"))
    report, problems, _ = api.run([*config, "--strict", "--no-error-summary", "--hide-error-context", *files])
    assert problems == ""
    errors: dict[str, list[str]] = {name: [] for name in programs}
    for line in report.splitlines():
        if ": error: " in line:
            errors[Path(line.partition(":")[0]).stem].append(line)
    return errors


def test_an_agent_with_every_decorator_type_checks(mypy_errors: dict[str, list[str]]) -> None:
    assert mypy_errors["good"] == []


@pytest.mark.parametrize("name", BAD)
def test_a_wrong_handler_is_a_type_error(mypy_errors: dict[str, list[str]], name: str) -> None:
    (error,) = mypy_errors[name]
    assert error.endswith(f"[{BAD[name][1]}]")


def test_every_public_name_can_be_imported() -> None:
    mesh = import_module("mesh")
    assert {"Agent", "Validator", "__version__"} < set(mesh.__all__)
    assert all(getattr(mesh, name) is not None for name in mesh.__all__)


def test_every_error_that_users_catch_has_a_code_of_its_own() -> None:
    mesh = import_module("mesh")
    public = [getattr(mesh, name) for name in mesh.__all__]
    errors: list[type[AiraError]] = [one for one in public if isinstance(one, type) and issubclass(one, AiraError)]
    assert len({error.code for error in errors}) == len(errors) > 10


@pytest.mark.parametrize(
    "statement", ["import mesh", "from mesh import Agent, Job, JobFailed, Settings", "import mesh; mesh.Agent()"]
)
def test_importing_mesh_does_not_load_the_chain(statement: str) -> None:
    program = f"import sys; {statement}; sys.exit(any(name in sys.modules for name in ('web3', 'eth_account')))"
    assert subprocess.run([sys.executable, "-c", program], check=False, cwd="/").returncode == 0


def test_examples_import_from_mesh_and_bridges_only() -> None:
    for path in (ROOT / "examples").glob("*/*.py"):
        for line in path.read_text().splitlines():
            if line.startswith(("from mesh.", "import mesh.", "from schemas", "from bridges")):
                public = ("from bridges.serial import Device", "from bridges.ros2 import ", "from mesh.testing import ")
                is_public = line.startswith(public)
                assert is_public, f"{path}: {line}"
