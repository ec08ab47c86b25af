"""`aira mcp`: the commands of the person: the policy's, and those that need a signer."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from mesh.errors import ConfigurationError
from tests.support.commands import invoke, refused

if TYPE_CHECKING:
    from collections.abc import Iterator

GUIDE = Path(__file__).parents[3] / "docs" / "guides" / "mcp.md"
POLICY = """\
[budget]
per_job = "5 XRT"
per_hour = "20 XRT"
per_day = "50 XRT"

[[allow]]
models = ["*"]
robots = ["*"]
[allow.topics."/drive"]
radius = { min = 0.2, max = 2.0 }
"""


@pytest.fixture
def policy(tmp_path: Path) -> Path:
    path = tmp_path / "policy.toml"
    path.write_text(POLICY)
    path.chmod(0o600)
    return path


def test_a_policy_is_explained(policy: Path) -> None:
    done = invoke("mcp", "policy", "explain", policy)
    assert done.returncode == 0
    assert "A job may cost at most 5 XRT." in done.stdout
    assert "/drive" in done.stdout


def test_a_policy_is_checked(policy: Path) -> None:
    done = invoke("mcp", "policy", "check", policy, "--json")
    assert done.returncode == 0
    assert json.loads(done.stdout)["rules"] == 1


def test_all_mistakes_of_a_policy_are_listed(policy: Path) -> None:
    policy.write_text(POLICY.replace("per_day", "per_dya").replace('"5 XRT"', '"five"'))
    done = invoke("mcp", "policy", "check", policy)
    assert done.returncode == 2
    assert "policy.toml:2:" in done.stderr
    assert "did you mean per_day?" in done.stderr
    assert "per_day is missing" not in done.stderr, "that was said"
    assert "policy check" not in done.stderr, "it is this command"


def test_a_policy_that_others_can_write_is_refused(policy: Path) -> None:
    policy.chmod(0o666)
    refused(invoke("mcp", "policy", "check", policy), ConfigurationError, code="policy-unsafe")


@pytest.mark.parametrize(
    "words",
    [("approve",), ("approve", "consent-0123456789abcdef"), ("deny", "consent-0123456789abcdef"), ("log",)],
    ids=" ".join,
)
def test_without_a_signer_the_error_says_how_to_start_it(tmp_path: Path, words: tuple[str, ...]) -> None:
    done = invoke("mcp", *words, "--data-dir", tmp_path)
    assert done.returncode == 1
    assert done.stdout == ""
    assert "no signer runs here [signer-unavailable]" in done.stderr
    assert "aira signer" in done.stderr


@pytest.mark.parametrize("words", [("approve", "job-0123456789abcdef"), ("deny", "12345")], ids=" ".join)
def test_what_is_no_consent_is_said_to_be_none(tmp_path: Path, words: tuple[str, ...]) -> None:
    done = invoke("mcp", *words, "--data-dir", tmp_path)
    assert "aira mcp approve" in refused(done, "invalid-request", words[1], exit_code=2)


def test_whether_a_program_may_bring_the_yes_is_explained(policy: Path) -> None:
    words = "nothing proves that it asked a person"
    policy.write_text(POLICY + '\n[consent]\nabove = "1 XRT"\n')
    assert words not in invoke("mcp", "policy", "explain", policy).stdout
    policy.write_text(POLICY + '\n[consent]\nabove = "1 XRT"\nby_client = true\n')
    assert words in invoke("mcp", "policy", "explain", policy).stdout
    policy.write_text(POLICY + '\n[consent]\nabove = "1 XRT"\nby_client = "yes"\n')
    assert "by_client is true or false" in invoke("mcp", "policy", "check", policy).stderr


def blocks(language: str) -> Iterator[str]:
    yield from re.findall(rf"^```{language}\n(.*?)^```", GUIDE.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL)


def test_the_policy_of_the_guide_is_one(policy: Path) -> None:
    (text,) = blocks("toml")
    policy.write_text(text)
    done = invoke("mcp", "policy", "explain", policy)
    assert done.returncode == 0, done.stderr
    assert "An order above 2 XRT needs a person's yes, within" in done.stdout


def test_the_clients_of_the_guide_start_the_door() -> None:
    servers = [one for text in blocks("json") for one in (json.loads(text).popitem()[1])["aira"].items()]
    assert {value for name, value in servers if name == "command"} == {"aira"}
    started = [value for name, value in servers if name == "args"]
    assert len(started) == 2
    for arguments in started:
        assert invoke(*arguments, "--help").returncode == 0
