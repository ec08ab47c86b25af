"""Policies: their mistakes with lines, what they say in plain words, and files that others could have written."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING

import pytest

from mesh.errors import ConfigurationError
from mesh.signer.policy import InvalidPolicy, Spending, parse_policy, read_policy_file
from tests.support.signer.hostile import OTHER_MODEL
from tests.support.signer.signers import LIMITS, RULE

if TYPE_CHECKING:
    from pathlib import Path

GOOD = (LIMITS + RULE.format(model=OTHER_MODEL, robots='["*"]')).encode()


@pytest.mark.parametrize(
    ("old", "new", "fault"),
    [
        ('above = "3 XRT"', 'abov = "3 XRT"', "9: unknown: 'abov'; did you mean above?"),
        ('per_hour = "20 XRT"', "", "2: per_hour is missing"),
        ('per_day = "50 XRT"', "per_day = 50", "5: per_day is a text with its unit"),
        ('per_day = "50 XRT"', 'per_day = "50 EUR"', "5: per_day: '50 EUR' is not an amount of XRT"),
        ("jobs_at_a_time = 8", "jobs_at_a_time = 0", "6: jobs_at_a_time is a number from 1 to 1000"),
        ("max = 2.0", "max = 0.1", "16: min is above max"),
        ("max = 2.0", "max = nan", "16: max is a number"),
        ("max = 2.0", "maximum = 2.0", '16: unknown: "maximum"'),
        ('one_of = ["left", "right"]', "one_of = []", "17: one_of is a list"),
        ("{ any = true, optional = true }", "{ optional = true }", "18: say one of: min and max; one_of; any"),
        ('"points[].x"', '"points].x"', '19: "points].x" is not the path of a field'),
        ("label", '"l\u0430bel"', ""),
        ("label", '"\uff4cabel"', "18: '\\uff4cabel' has characters that look like others"),
        ('"/speed"', '"speed"', '20: "speed" is not a topic'),
        ('robots = ["*"]', 'robots = ["Rover"]', "14: 'Rover' is not one of the addresses of robots"),
        ('robots = ["*"]', "", "12: robots is a list of the addresses of robots"),
        ("[allow.topics.", "[allow.topic.", "15: unknown: 'topic'; did you mean topics?"),
        ("[budget]", "[budget", "2: not TOML"),
        ('valid = "10 min"', 'valid = "10 weeks"', "10: valid is from 10 s to 1 d"),
        ("jobs_at_a_time = 8", 'hours = "Mo-Fr"', "6: hours: it is not like"),
    ],
)
def test_a_mistake_is_named_with_its_line(old: str, new: str, fault: str) -> None:
    changed = GOOD.decode().replace(old, new)
    assert changed != GOOD.decode()
    if not fault:
        parse_policy(changed.encode())  # another name, which is only compared
        return
    with pytest.raises(InvalidPolicy) as caught:
        parse_policy(changed.encode(), name="p.toml")
    assert any(one.startswith(f"p.toml:{fault}") for one in caught.value.faults), caught.value.faults


def test_a_policy_is_explained_in_plain_words() -> None:
    words = "\n".join(parse_policy(GOOD).words())
    for said in (
        "A job may cost at most 5 XRT.",
        "An order above 3 XRT needs a person's yes, within 10 minutes.",
        f"Rule 1: the model {OTHER_MODEL}, by any robot",
        'direction: "left" or "right"',
        "radius: 0.2 to 2",
        "points[].x: 0 to 5, or nothing",
        "/stop (no value)",
    ):
        assert said in words


def test_an_order_must_fit_one_rule_as_a_whole() -> None:
    second = RULE.format(model=OTHER_MODEL, robots='["*"]').replace("/drive", "/arm")
    policy = parse_policy(GOOD + second.encode())
    good = {"radius": 1, "direction": "left"}
    assert not isinstance(policy.rules_allowing(OTHER_MODEL, [("/drive", good), ("/stop", None)]), type(None))
    found = policy.rules_allowing(OTHER_MODEL, [("/drive", good), ("/arm", good)])
    assert getattr(found, "code", "") == "topic-not-allowed"


def test_hours_and_jobs_are_judged_before_money() -> None:
    policy = parse_policy(GOOD.replace(b"jobs_at_a_time = 8", b'jobs_at_a_time = 1\nhours = "Mon-Fri 08:00-18:00 UTC"'))
    monday = 1_795_424_400.0  # 2026-11-23 09:00 UTC
    nothing = Spending(0, 0, 0)
    assert policy.decide(1, nothing, monday).verdict == "allowed"
    assert policy.decide(1, nothing, monday + 10 * 3600).code == "outside-hours"
    assert policy.decide(1, Spending(0, 0, 1), monday).code == "too-many-jobs"
    assert policy.decide(4 * 10**9, nothing, monday).verdict == "needs-consent"
    assert policy.decide(4 * 10**9, nothing, monday, has_consent=True).verdict == "allowed"
    assert policy.decide(1, Spending(20 * 10**9, 20 * 10**9, 0), monday).code == "hour-budget-spent"
    assert policy.decide(1, Spending(0, 50 * 10**9, 0), monday).code == "day-budget-spent"


def test_a_file_that_others_could_have_written_is_refused(tmp_path: Path) -> None:
    folder = tmp_path / "own"
    folder.mkdir(mode=0o700)
    path = folder / "policy.toml"
    path.write_bytes(GOOD)
    path.chmod(0o600)
    assert read_policy_file(path) == GOOD
    link, hard = folder / "link.toml", folder / "hard.toml"
    link.symlink_to(path)
    attempts = [("it is a link", link)]
    for mode in (0o620, 0o602, 0o666):
        path.chmod(mode)
        with pytest.raises(ConfigurationError, match="others may write to it"):
            read_policy_file(path)
    path.chmod(0o600)
    folder.chmod(0o777)
    with pytest.raises(ConfigurationError, match="others may write to its folder"):
        read_policy_file(path)
    folder.chmod(0o700)
    attempts += [
        ("it is no plain file", folder / "pipe"),
        ("it is no plain file", folder),
        ("No such", folder / "none"),
    ]
    os.mkfifo(folder / "pipe")
    for why, one in attempts:
        with pytest.raises(ConfigurationError, match=why) as caught:
            read_policy_file(one)
        assert caught.value.code == "policy-unsafe"
    hard.hardlink_to(path)
    with pytest.raises(ConfigurationError, match="other names"):
        read_policy_file(path)


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can give a file away")
def test_a_file_of_another_user_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "policy.toml"
    path.write_bytes(GOOD)
    path.chmod(0o600)
    os.chown(path, 12345, 12345)
    with pytest.raises(ConfigurationError, match="belongs to another user"):
        read_policy_file(path)
