"""Selectors match their keys, and no others."""

from __future__ import annotations

import ast
from pathlib import Path
from typing import Any

import pytest
import zenoh

from schemas import (
    DeviceTopicKey,
    EventKey,
    InvalidKey,
    Key,
    LiabilityTopicKey,
    ObjectiveTopicKey,
    ProgressKey,
    ReadingKey,
    device_selector,
    event_selector,
    lighthouse_selector,
    market_selector,
    objective_selector,
    presence_selector,
    reading_selector,
    topic_selector,
)
from schemas.selectors import withdrawal_selector
from tests.schemas.sample_keys import KEYS, A, L
from tests.schemas.samples import LIGHTHOUSE, MODEL, SENDER
from tests.schemas.samples import LIGHTHOUSE_NAME as NAME


def test_market_selectors() -> None:
    assert market_selector(NAME, "demand") == f"aira/{NAME}/demand/*"
    assert market_selector(NAME.upper(), "offer", MODEL) == f"aira/{NAME}/offer/{MODEL}"
    assert market_selector(NAME, "decline", SENDER) == f"aira/{NAME}/decline/{A}"
    assert market_selector(NAME, "reject") == f"aira/{NAME}/reject/*"
    assert market_selector(NAME, "reject", SENDER) == f"aira/{NAME}/reject/{A}"
    one_key: tuple[Any, ...] = ("result", "withdrawal", "feedback", "pending")
    for kind in one_key:
        assert market_selector(NAME, kind) == f"aira/{NAME}/{kind}"


def test_withdrawals_of_one_order_are_asked_for_by_its_hash() -> None:
    assert withdrawal_selector(NAME, "ab" * 32) == f"aira/{NAME}/withdrawal?order={'ab' * 32}"
    for text in ("", "AB" * 32, "ab" * 31, "0x" + "ab" * 32, "*"):
        with pytest.raises(InvalidKey):
            withdrawal_selector(NAME, text)


@pytest.mark.parametrize(("key", "text"), KEYS[:8], ids=lambda value: value if isinstance(value, str) else "")
def test_market_selector_finds_its_kind(key: Key, text: str) -> None:
    kind: Any = text.split("/")[2]
    found = zenoh.KeyExpr(market_selector(NAME, kind))
    assert [found.intersects(zenoh.KeyExpr(other)) for _, other in KEYS] == [
        type(other) is type(key) for other, _ in KEYS
    ]
    assert zenoh.KeyExpr(lighthouse_selector(NAME)).includes(zenoh.KeyExpr(text))


def test_selectors_of_an_agent_find_their_keys() -> None:
    for selector, kinds in (
        (event_selector(SENDER), (EventKey, ProgressKey)),
        (event_selector(SENDER, LIGHTHOUSE), (EventKey, ProgressKey)),
        (objective_selector(SENDER, LIGHTHOUSE), (ObjectiveTopicKey,)),
        (topic_selector(SENDER, LIGHTHOUSE), (LiabilityTopicKey,)),
        (topic_selector(SENDER, topic="/blink"), (LiabilityTopicKey,)),
        (event_selector(), (EventKey, ProgressKey)),
        (reading_selector(), (ReadingKey,)),
        (reading_selector(SENDER, "/battery"), (ReadingKey,)),
        (device_selector(SENDER), (DeviceTopicKey,)),
        (device_selector(SENDER, "tty-0"), (DeviceTopicKey,)),
    ):
        for key, text in KEYS:
            assert zenoh.KeyExpr(selector).intersects(zenoh.KeyExpr(text)) == isinstance(key, kinds)


def test_presence_is_found_by_its_own_selector_only() -> None:
    presence = zenoh.KeyExpr(KEYS[8][1])
    assert zenoh.KeyExpr(presence_selector(NAME)).includes(presence)
    assert zenoh.KeyExpr(presence_selector(NAME, "provider")).includes(presence)
    assert not zenoh.KeyExpr(presence_selector(NAME, "agent")).intersects(presence)
    assert not zenoh.KeyExpr(lighthouse_selector(NAME)).intersects(presence)


def test_selectors_are_checked() -> None:
    wrong: Any = "bid"
    with pytest.raises(InvalidKey):
        market_selector(NAME, wrong)
    with pytest.raises(InvalidKey):
        market_selector(NAME, "demand", "**")
    with pytest.raises(InvalidKey):
        market_selector(NAME, "result", MODEL)
    with pytest.raises(InvalidKey):
        market_selector(NAME, "reject", MODEL)
    with pytest.raises(InvalidKey):
        lighthouse_selector("*")
    with pytest.raises(InvalidKey):
        presence_selector(NAME, "**")
    with pytest.raises(InvalidKey):
        device_selector(A, "a/b")
    with pytest.raises(InvalidKey):
        topic_selector("*", L)


NOT_FROM_SCHEMAS = {
    "mesh/identity/access_rules.py": "rights on everything",
    "mesh/identity/roster.py": "the shapes of keys on which roles have rights",
    "mesh/doctor/session.py": "keys that no family has, which a router must refuse",
    "mesh/work/run.py": "an encoding",
}


def test_keys_and_selectors_are_built_here_only() -> None:
    root = Path(__file__).parents[2]
    paths = [path for folder in ("mesh", "bridges", "schemas") for path in (root / folder).rglob("*.py")]
    building = {
        str(path.relative_to(root))
        for path in paths
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and node.value.startswith("aira/")
    }
    assert building == {"schemas/agent_keys.py", "schemas/keys.py", "schemas/selectors.py", *NOT_FROM_SCHEMAS}
