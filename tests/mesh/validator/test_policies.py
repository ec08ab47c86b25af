"""What the shipped policies demand, on messages at given times."""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING, Any

import pytest

from mesh import ConfigurationError
from mesh.recording import Played
from mesh.settings import Settings
from mesh.validator.judging import POLICIES, Evidence, JudgedMessage, policy_of
from mesh.validator.validator import Validator
from schemas.model import ModelDescription, ModelTopic, ValueSchema
from schemas.payloads import PayloadType, encode_value
from tests.support.agent.samples import liability
from tests.support.raising import raises_with

if TYPE_CHECKING:
    from mesh.validator.judging import Policy

COMMAND, ANSWER, OTHER = ("/do", "objective"), ("/done", "device"), ("/else", "device")
PAIRED = policy_of("acknowledged:command=/do:answer=/done")


def said(who: tuple[str, str], seconds: float, *, part: int = 0, value: object = 1.0) -> JudgedMessage:
    """A message at a time."""
    payload, kind = encode_value(value)
    return sent(who, payload, kind, seconds=seconds, part=part)


def sent(
    who: tuple[str, str], payload: bytes, kind: PayloadType, *, seconds: float = 0.0, part: int = 0
) -> JudgedMessage:
    topic, role = who
    time = round(seconds * 1e9)
    return JudgedMessage(Played(topic, payload, time, time, 0, kind, role), part=part, start_ns=0)


def found(policy: Policy, *messages: JudgedMessage, model: ModelDescription | None = None) -> dict[str, bool | None]:
    """The findings of a policy by name."""
    check = policy.begin(Evidence(liability(), model=model))
    for message in messages:
        check.add(message)
    return {finding.name: finding.holds for finding in check.findings()}


@pytest.mark.parametrize(
    ("policy", "messages", "holds"),
    [
        (PAIRED, [said(COMMAND, 0), said(ANSWER, 1.0)], True),
        (PAIRED, [said(COMMAND, 0), said(ANSWER, 1.1)], False),
        (PAIRED, [said(ANSWER, 0), said(COMMAND, 0.1)], False),
        (PAIRED, [said(COMMAND, 0), said(OTHER, 0.5)], False),
        (PAIRED, [said(COMMAND, 0), said(COMMAND, 0.1), said(ANSWER, 0.2)], False),
        (PAIRED, [said(COMMAND, 0), said(COMMAND, 0), said(ANSWER, 0.9), said(ANSWER, 1.8)], True),
        (PAIRED, [said(COMMAND, 0), said(COMMAND, 0), said(ANSWER, 0.9), said(ANSWER, 2.0)], False),
        (POLICIES["acknowledged"], [said(COMMAND, 0), said(COMMAND, 0.1), said(OTHER, 0.2)], True),
        (POLICIES["acknowledged"], [said(COMMAND, 0), said(OTHER, 1.2)], False),
        (policy_of("acknowledged:within=2s"), [said(COMMAND, 0), said(OTHER, 1.2)], True),
        (policy_of("acknowledged:command=/other"), [said(COMMAND, 0)], True),
    ],
)
def test_each_command_needs_an_answer_in_time(policy: Policy, messages: list[JudgedMessage], holds: bool) -> None:
    assert found(policy, *messages) == {"answers": holds}


@pytest.mark.parametrize(
    ("after", "holds"),
    [
        ([], False),
        ([said(ANSWER, 60.5, part=1)], True),
        ([said(OTHER, 60, part=1), said(ANSWER, 60.5, part=1)], True),
        ([said(OTHER, 60, part=1), said(ANSWER, 61.5, part=1)], False),
        ([said(OTHER, 60, part=1), said(COMMAND, 90, part=1), said(ANSWER, 90.5, part=1)], True),
        ([said(OTHER, 60, part=1), said(COMMAND, 90, part=1, value=2.0), said(ANSWER, 90.5, part=1)], False),
    ],
)
def test_a_command_that_was_open_at_a_crash_is_played_again_or_answered_soon(
    after: list[JudgedMessage], holds: bool
) -> None:
    assert found(PAIRED, said(COMMAND, 0), *after) == {"answers": holds}


def test_a_command_that_was_overdue_at_a_crash_stays_so() -> None:
    messages = [said(COMMAND, 0), said(OTHER, 1.5), said(ANSWER, 60, part=1)]
    assert found(PAIRED, *messages) == {"answers": False}


@pytest.mark.parametrize(
    ("text", "times", "expected"),
    [
        ("rate", [0, 9, 18], {"rate": True, "gaps": True}),
        ("rate", [0, 9, 20], {"rate": True, "gaps": False}),
        ("rate:gap=2s:min=1", [0, 1, 2, 3], {"rate": True, "gaps": True}),
        ("rate:gap=2s:min=2", [0, 1, 2, 3], {"rate": False, "gaps": True}),
        ("rate:max=1", [0, 1, 2], {"rate": False, "gaps": True}),
        ("rate:max=2", [0, 1, 2], {"rate": True, "gaps": True}),
        ("rate:topic=/nothing", [0, 1, 2], {"rate": False}),
    ],
)
def test_messages_come_at_a_rate_and_without_gaps(text: str, times: list[float], expected: dict[str, bool]) -> None:
    assert found(policy_of(text), *(said(ANSWER, time) for time in times)) == expected


def test_time_before_the_first_and_after_the_last_message_of_a_topic_counts() -> None:
    late = [said(COMMAND, 0), said(ANSWER, 11), said(ANSWER, 12)]
    assert found(POLICIES["rate"], *late)["gaps"] is False
    early = [said(ANSWER, 0), said(ANSWER, 1), said(COMMAND, 12)]
    assert found(POLICIES["rate"], *early)["gaps"] is False


def test_a_crash_is_no_gap_but_the_time_before_it_counts() -> None:
    assert found(POLICIES["rate"], said(ANSWER, 0), said(ANSWER, 100, part=1))["gaps"] is True
    silent = [said(ANSWER, 0), said(COMMAND, 12), said(ANSWER, 100, part=1)]
    assert found(POLICIES["rate"], *silent)["gaps"] is False


def described(schema: bytes) -> PayloadType:
    return PayloadType("json", "it", "jsonschema", schema)


DEEP = b'{"a":' * 700 + b"1" + b"}" * 700


@pytest.mark.parametrize(
    ("payload", "kind", "wrong"),
    [
        (b"\x01\x02", PayloadType("application/octet-stream"), None),
        (b"\x01\x02", PayloadType("protobuf", "it"), "types"),
        (b"\x01\x02", PayloadType("cdr", "std_msgs/msg/Float64", "ros2msg", b"float64 data\n"), "types"),
        (b'{"x":1}', described(b'{"type":"object","properties":{"x":{"type":"string"}}}'), "limits"),
        (b'{"x":1}', described(b'{"type":"object","properties":{"y":{}},"required":["y"]}'), "limits"),
        (b"[3,11]", described(b'{"type":"array","items":{"type":"integer","maximum":10}}'), "limits"),
        (b'{"x":1}', described(b"not a schema"), None),
        (b'{"x":1}', described(b'{"type":"object","properties":{"x":{"anyOf":[]}},"required":7}'), None),
        (b'{"x":1}', described(b'{"type":["object"],"$ref":"#"}'), None),
        (encode_value([1.0, float("nan")])[0], encode_value([1.0])[1], "finite"),
    ],
)
def test_messages_are_of_their_types_and_within_their_schemas(
    payload: bytes, kind: PayloadType, wrong: str | None
) -> None:
    holds = found(POLICIES["schema"], sent(ANSWER, payload, kind))
    assert {name for name, held in holds.items() if not held} == ({wrong} if wrong else set())


def test_a_message_that_is_nested_too_deep_is_not_of_its_type() -> None:
    limit = sys.getrecursionlimit()
    sys.setrecursionlimit(1000)  # as it is by default
    try:
        holds = found(POLICIES["schema"], sent(ANSWER, DEEP, described(b'{"type":"object"}')))
    finally:
        sys.setrecursionlimit(limit)
    assert holds["types"] is False


def test_messages_are_as_the_model_says_of_results() -> None:
    wanted = ModelTopic(topic="/done", required=True, value=ValueSchema(type="number", maximum=2))
    model = ModelDescription(title="it", result=(wanted,))
    schema: Any = POLICIES["schema"]
    assert found(schema, said(ANSWER, 0, value=1.5), model=model)["model"] is True
    assert found(schema, said(ANSWER, 0, value=2.5), model=model)["model"] is False
    assert found(schema, said(OTHER, 0, value=1.5), model=model)["model"] is False
    assert "model" not in found(schema, said(ANSWER, 0, value=2.5))


def test_a_validator_has_a_policy_several_times_with_other_options_only() -> None:
    several = ["rate:topic=/imu:min=50", "rate:topic=/gps:min=1"]
    validator = Validator(settings=Settings(), policies=several)
    assert [policy.name for policy in validator.policies] == ["complete", "rate", "rate"]
    with raises_with(ConfigurationError, code="invalid-policy"):
        Validator(settings=Settings(), policies=[*several, several[0]])
    for name in ("rate", "complete"):
        with raises_with(ConfigurationError, code="invalid-policy"):
            validator.check(name, description="Mine.")(lambda evidence: True)


def test_values_beyond_counting_are_a_finding() -> None:
    payload = b"[" + b",".join([b"[]"] * 1_000_000) + b"]"
    messages = [sent(ANSWER, payload, described(b"{}"), seconds=number) for number in range(6)]
    assert found(POLICIES["schema"], *messages)["limits"] is False
