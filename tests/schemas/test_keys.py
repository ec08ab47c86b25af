"""The keyspace."""

from __future__ import annotations

from contextlib import suppress
from typing import Any

import pytest
import zenoh
from hypothesis import given
from hypothesis import strategies as st

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
    RejectKey,
    RpcKey,
    parse_key,
)
from tests.schemas.sample_keys import KEYS, A, L
from tests.schemas.samples import LIGHTHOUSE, MODEL, SENDER
from tests.schemas.samples import LIGHTHOUSE_NAME as NAME
from tests.schemas.samples import NONCE as HASH


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
