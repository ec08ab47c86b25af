"""The keyspace: keys, and the selectors that match them."""

from __future__ import annotations

import ast
from contextlib import suppress
from pathlib import Path
from typing import Any, get_args

import pytest
import zenoh
from hypothesis import given
from hypothesis import strategies as st

from mesh.ops.identity.roster import ROLES
from schemas import (
    CidKey,
    DemandKey,
    DeviceTopicKey,
    EthEventKey,
    EventKey,
    InvalidKey,
    Key,
    LiabilityTopicKey,
    ObjectiveTopicKey,
    OfferKey,
    PendingKey,
    PresenceKey,
    ProgressKey,
    ReadingKey,
    RejectKey,
    RpcKey,
    device_selector,
    event_selector,
    lighthouse_selector,
    market_selector,
    objective_selector,
    parse_key,
    presence_selector,
    reading_selector,
    topic_selector,
)
from schemas.keys import KINDS, MarketKey, MarketKind, withdrawal_selector
from schemas.messages import MESSAGE_TYPES
from tests.support.schemas.sample_keys import KEYS, A, L
from tests.support.schemas.samples import LIGHTHOUSE, MODEL, SENDER
from tests.support.schemas.samples import LIGHTHOUSE_NAME as NAME
from tests.support.schemas.samples import NONCE as HASH


@pytest.mark.parametrize(("key", "text"), KEYS, ids=lambda value: value if isinstance(value, str) else "")
def test_a_key_and_its_text_convert_both_ways(key: Key, text: str) -> None:
    assert str(key) == text
    assert parse_key(text) == key
    assert type(parse_key(text)) is type(key)
    assert str(zenoh.KeyExpr(text)) == text


def test_keys_are_held_in_canonical_form() -> None:
    key = RejectKey(NAME.upper(), SENDER)
    assert (key.lighthouse, key.maker) == (NAME, A)
    assert key == RejectKey(NAME, A)


def test_lighthouse_without_a_name_is_named_by_its_address() -> None:
    assert str(PendingKey(LIGHTHOUSE)) == f"aira/{L}/pending"
    assert parse_key(f"aira/{L}/pending") == PendingKey(L)


@pytest.mark.parametrize("topic", ["/blink", "/a/b/c", "/liability/eth_0x1/blink", "/~x", "/a.b", "/" + "a" * 256])
def test_topics_round_trip(topic: str) -> None:
    key = parse_key(str(ObjectiveTopicKey(A, L, topic)))
    assert isinstance(key, ObjectiveTopicKey)
    assert key.topic == topic


@pytest.mark.parametrize(
    "topic",
    [
        "",
        "/",
        "blink",
        "//a",
        "/a/",
        "/a//b",
        "/*",
        "/a/**",
        "/a$*",
        "/a?b",
        "/a#b",
        "/a b",
        "/a\n",
        "/a\0",
        "/@a",
        "/é",
        "/..",
        "/a/../b",
        "/" + "a" * 257,
    ],
)
def test_invalid_topics_are_refused(topic: str) -> None:
    for build in (ObjectiveTopicKey, LiabilityTopicKey):
        with pytest.raises(InvalidKey):
            build(A, L, topic)
    with pytest.raises(InvalidKey):
        DeviceTopicKey(A, "device", topic)


@pytest.mark.parametrize("text", ["", "*", "**", "a/b", "a b", "@a", "a\n", "\0", "é", "..", "a" * 257])
def test_invalid_names_are_refused(text: str) -> None:
    with pytest.raises(InvalidKey):
        DeviceTopicKey(A, text, "/a")
    with pytest.raises(InvalidKey):
        PresenceKey(NAME, text, A)
    if text != "a/b":
        with pytest.raises(InvalidKey):
            RpcKey(A, text)


@pytest.mark.parametrize("text", ["", "airalab", "*", "airalab.com", "a/b.eth", "air alab.eth", "agent", "cid", L[:-1]])
def test_lighthouse_is_a_name_or_an_address(text: str) -> None:
    with pytest.raises(InvalidKey):
        DemandKey(text, MODEL)


@pytest.mark.parametrize("text", ["", "*", MODEL[:-1], "Q" * 46])
def test_model_is_a_cid(text: str) -> None:
    with pytest.raises(InvalidKey):
        OfferKey(NAME, text)
    with pytest.raises(InvalidKey):
        CidKey(A, text)


@pytest.mark.parametrize("text", ["", "*", NAME, L[2:], "0x" + "g" * 40])
def test_agent_is_an_address(text: str) -> None:
    with pytest.raises(InvalidKey):
        RpcKey(text, "start")


def test_unknown_events_are_refused() -> None:
    event: Any
    for event in ("transfer", "started", "*", "", "READY"):
        with pytest.raises(InvalidKey):
            EventKey(A, L, event)
    for event in ("ready", "mint", "*", ""):
        with pytest.raises(InvalidKey):
            EthEventKey(A, event)


@pytest.mark.parametrize(
    "text",
    [
        "",
        "/",
        "aira",
        "aira/",
        f"/aira/agent/{A}/cid/{MODEL}",
        f"aira/cid/{MODEL}",
        f"aira/agent/{A}/cid/{MODEL}/",
        f"aira/agent/{A}/cid/{MODEL}/{MODEL}",
        "aira/**",
        f"aira/{NAME}/demand/*",
        f"aira/{NAME}/demand/{MODEL}/{HASH}",
        f"aira/{NAME}/demand",
        f"aira/{NAME}/bid/{MODEL}",
        f"aira/{NAME}/result/{L}",
        f"aira/{NAME}/withdrawal/{HASH}",
        f"aira/{NAME}/@agent/provider/*",
        f"aira/agent/{A}",
        f"aira/agent/{A}/liability/{L}",
        f"aira/agent/{A}/liability/{L}/objective",
        f"aira/agent/{A}/liability/{L}/topic",
        f"aira/agent/{A}/liability/{L}/topic/",
        f"aira/agent/{A}/liability/{L}/unheard",
        f"aira/agent/{A}/device/d",
        f"aira/agent/{A}/rpc",
        f"aira/agent/{A}/rpc/",
        f"aira/agent/{A}/eth/event",
        f"aira/agent/{A}/liability/{L}/topic/" + "a/" * 300 + "a",
    ],
)
def test_invalid_keys_are_refused(text: str) -> None:
    with pytest.raises(InvalidKey):
        parse_key(text)


@pytest.mark.parametrize(
    "text",
    [
        f"aira/{NAME.upper()}/pending",
        f"aira/agent/{SENDER}/rpc/start",
        f"aira/{NAME}/reject/{SENDER}",
    ],
)
def test_only_the_canonical_text_of_a_key_is_accepted(text: str) -> None:
    with pytest.raises(InvalidKey) as caught:
        parse_key(text)
    assert "canonical" in caught.value.why
    assert caught.value.text == text


chunks = st.sampled_from(
    (
        "aira",
        "agent",
        "cid",
        "demand",
        "liability",
        "objective",
        "topic",
        "rpc",
        "eth",
        "event",
        NAME,
        A,
        MODEL,
        HASH,
        "",
    )
)


@given(st.text(max_size=60) | st.lists(chunks | st.text(max_size=5), max_size=8).map("/".join))
def test_any_text_is_a_key_or_raises_invalid_key(text: str) -> None:
    with suppress(InvalidKey):
        assert str(parse_key(text)) == text


@given(st.lists(chunks | st.text(max_size=5), min_size=5, max_size=8).map("/".join))
def test_every_key_is_a_key_of_zenoh_without_wildcards(text: str) -> None:
    try:
        parse_key(text)
    except InvalidKey:
        return
    assert "*" not in str(zenoh.KeyExpr(text))


def test_the_table_of_kinds_is_complete() -> None:
    assert set(KINDS) == set(get_args(MarketKind))
    assert {kind.key for kind in KINDS.values()} == set(get_args(MarketKey))
    assert {message.kind for message in MESSAGE_TYPES} <= KINDS.keys()
    for name, kind in KINDS.items():
        assert kind.key.pattern.split("/")[2] == name
        assert set(kind.put_by) <= ROLES.keys()


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


@pytest.mark.parametrize(("key", "text"), KEYS[:9], ids=lambda value: value if isinstance(value, str) else "")
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
    presence = zenoh.KeyExpr(KEYS[9][1])
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
    "mesh/ops/identity/roster.py": "rights on everything, and the shapes of keys on which roles have rights",
    "mesh/ops/doctor/_session.py": "keys that no family has, which a router must refuse",
    "mesh/agent/jobs.py": "an encoding",
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
    assert building == {"schemas/keys.py", *NOT_FROM_SCHEMAS}
