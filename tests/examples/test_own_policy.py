"""The validator with a policy of its own judges the job of the README, by the command line."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import pytest

from tests.support.commands import AIRA, Serving, aira, run
from tests.support.lessons import EXAMPLES, as_role, market

__all__ = ["market"]

EXAMPLE = EXAMPLES / "hello_mesh"


def command(variables: dict[str, str], *words: str | Path) -> Any:
    """Run an `aira` command that prints JSON."""
    done = run("env", *(f"{name}={value}" for name, value in variables.items()), *AIRA, *words, "--json")
    assert done.returncode == 0, done.stderr
    return [json.loads(line) for line in done.stdout.splitlines()]


class Bench:
    """A validator contract with one juror, and the programs of the example."""

    def __init__(self, market: dict[str, str], folder: Path) -> None:
        name = "airalab.lighthouse.3.robonomics.eth"
        self.market = market | {"AIRA_GENERATION": "5", "AIRA_LIGHTHOUSE_CONTRACT": name}
        password = Path(market["AIRA_KEYFILE_PASSWORD_FILE"])
        juror = aira("account", "new", folder / "juror.json", "--password-file", password).stdout.strip()
        (made,) = command(as_role("person", self.market), "validator", "deploy", "--juror", juror)
        self.contract: str = made["validator"]
        self.juror = self.market | {
            "AIRA_KEYFILE": str(folder / "juror.json"),
            "AIRA_VALIDATOR_CONTRACT": self.contract,
            "AIRA_LOG_FORMAT": "json",
        }

    def validator(self) -> Serving:
        return Serving(sys.executable, EXAMPLE / "validator.py", says="validator-started", variables=self.juror)

    def robot(self) -> Serving:
        return Serving(sys.executable, EXAMPLE / "robot.py", says="account 0x", variables=as_role("robot", self.market))

    def demand(self, *words: str | Path) -> list[dict[str, Any]]:
        """What `aira demand` reports of one job."""
        model = aira("cid", EXAMPLE / "model.md").stdout.strip()
        order = ("--cost", "1000wn", "--model", model, "--objective", EXAMPLE / "blink.mcap")
        found: list[dict[str, Any]] = command(
            as_role("person", self.market), "demand", *order, "--validator", self.contract, "--yes", *words
        )
        return found


@pytest.fixture
def bench(market: dict[str, str], tmp_path: Path) -> Bench:
    return Bench(market, tmp_path)


def test_a_job_is_judged_by_the_policy_and_paid(bench: Bench) -> None:
    with bench.robot(), bench.validator() as validator:
        said = bench.demand()
        assert said[0]["kind"] == "validator"
        assert [policy["name"] for policy in said[0]["policies"]] == ["complete", "schema", "lamp-answers"]
        assert said[-1]["success"]
        signed = [json.loads(line) for line in validator.log().splitlines() if "verdict-signed" in line]
        assert [event["success"] for event in signed] == ["True"]
