"""Every identity tries everything on every family of keys, over TLS, on both routers: what may be has its effect, and
nothing else has."""

from __future__ import annotations

import threading
from collections import defaultdict
from contextlib import ExitStack
from typing import TYPE_CHECKING, Any

import pytest
import zenoh

from tests.support.identity.players import (
    ADDRESSES,
    DELETE,
    GET,
    KEYS,
    MEMBERS,
    PRESENCE,
    PUT,
    SERVE,
    SUBSCRIBE,
    TOKEN,
    WHO,
)
from tests.support.sites import Site
from tests.support.waiting import until, until_heard

if TYPE_CHECKING:
    from collections.abc import Iterator

SECONDS = 60.0
REFUSED = 3.0
"""Seconds in which a question that is let through is answered, unless the machine is busy: then it is asked again."""
ALL_TOKENS = ("aira/**", "aira/*/@agent/*/*")


class Stage:
    """All identities, each with a session of its own; the witness may do and see everything."""

    def __init__(self, site: Site, stack: ExitStack) -> None:
        folders = {member.name: site.enlist(member) for member in MEMBERS}
        folders["stranger"] = site.certify("stranger", ADDRESSES["stranger"], "agent")
        stack.enter_context(site.open_router(site.kind))
        self.sessions = {
            name: stack.enter_context(zenoh.open(site.client(folder).config())) for name, folder in folders.items()
        }
        self.witness = self.sessions["witness"]
        self._kept: list[Any] = []

    def keep(self, declared: Any) -> None:
        """Something to withdraw at the end of the test."""
        self._kept.append(declared)

    def clear(self) -> None:
        """Undeclare everything that the test declared."""
        for declared in self._kept:
            declared.undeclare()
        self._kept.clear()

    def are_past(self) -> None:
        """Return when the router has processed all messages of the identities: each sends a forbidden query."""
        ask_all({who: [(who, "aira/nobody")] for who in WHO}, self.sessions, seconds=1.0)


@pytest.fixture(scope="module", params=["wheel", "zenohd"])
def opened(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Stage]:
    site = Site(tmp_path_factory.mktemp("site"))
    site.kind = request.param
    with ExitStack() as stack:
        yield Stage(site, stack)


@pytest.fixture
def stage(opened: Stage) -> Iterator[Stage]:
    yield opened
    opened.clear()


def named(who: str, keys: set[str]) -> set[str]:
    """The families of those keys, as the identity names them."""
    return {name for name, key in KEYS[who].items() if key in keys}


def ask_all(
    questions: dict[str, list[tuple[str, str]]], sessions: dict[str, zenoh.Session], *, seconds: float
) -> dict[str, set[str]]:
    """Query all keys at the same time; the answered keys by identity."""
    lock, answered, threads = threading.Lock(), defaultdict[str, set[str]](set), []

    def ask(who: str, session: zenoh.Session, selectors: list[str]) -> None:
        handlers = [session.get(selector, timeout=seconds, target=zenoh.QueryTarget.ALL) for selector in selectors]
        for selector, replies in zip(selectors, handlers, strict=True):
            if any(reply.ok is not None for reply in replies):
                with lock:
                    answered[who].add(selector)

    for who, asked in questions.items():
        threads.append(threading.Thread(target=ask, args=(who, sessions[who], [key for _, key in asked])))
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    return answered


async def heard_by_witness(stage: Stage, kind: zenoh.SampleKind, expected: dict[str, set[str]]) -> dict[str, set[str]]:
    """The messages that the witness receives when each identity publishes or deletes on each of its keys."""
    heard = defaultdict[str, set[str]](set)

    def hear(sample: zenoh.Sample) -> None:
        if sample.kind == kind and sample.attachment is not None:
            heard[sample.attachment.to_string()].add(str(sample.key_expr))

    for selector in ALL_TOKENS:
        stage.keep(stage.witness.declare_subscriber(selector, hear))

    def all_heard() -> bool:
        for who in WHO:
            for key in KEYS[who].values():
                if kind == zenoh.SampleKind.PUT:
                    stage.sessions[who].put(key, b"", attachment=who, congestion_control=zenoh.CongestionControl.BLOCK)
                else:
                    stage.sessions[who].delete(key, attachment=who, congestion_control=zenoh.CongestionControl.BLOCK)
        return all(expected[who] <= named(who, heard[who]) for who in WHO)

    await until(all_heard, seconds=SECONDS, pause=0.1)
    stage.are_past()
    return {who: named(who, heard[who]) for who in WHO}


@pytest.mark.parametrize(("kind", "expected"), [(zenoh.SampleKind.PUT, PUT), (zenoh.SampleKind.DELETE, DELETE)])
async def test_each_member_writes_only_what_it_may(
    stage: Stage, kind: zenoh.SampleKind, expected: dict[str, set[str]]
) -> None:
    assert await heard_by_witness(stage, kind, expected) == expected


async def test_each_member_answers_only_on_its_own_keys(stage: Stage) -> None:
    for who in WHO:
        for key in KEYS[who].values():

            def answer(query: zenoh.Query, who: str = who) -> None:
                with query:
                    query.reply(query.key_expr, who)

            stage.keep(stage.sessions[who].declare_queryable(key, answer))
    stage.are_past()

    def replies() -> dict[str, set[str]]:
        found = {who: set[str]() for who in WHO}
        for key in {key for who in WHO for key in KEYS[who].values()}:
            for reply in stage.witness.get(
                key, timeout=SECONDS, target=zenoh.QueryTarget.ALL, consolidation=zenoh.ConsolidationMode.NONE
            ):
                assert reply.ok is not None
                who = reply.ok.payload.to_string()
                found[who] |= named(who, {key})
        return found

    await until(lambda: all(SERVE[who] <= found for who, found in replies().items()), seconds=SECONDS)
    assert replies() == SERVE


@pytest.mark.parametrize("who", WHO)
async def test_each_member_declares_only_its_own_tokens(stage: Stage, who: str) -> None:
    def shown() -> set[str]:
        liveliness = stage.witness.liveliness()
        replies = [reply for selector in ALL_TOKENS for reply in liveliness.get(selector, timeout=SECONDS)]
        return named(who, {str(reply.ok.key_expr) for reply in replies if reply.ok is not None})

    for key in KEYS[who].values():
        stage.keep(stage.sessions[who].liveliness().declare_token(key))
    await until(lambda: TOKEN[who] <= shown(), seconds=SECONDS)
    stage.are_past()
    assert shown() == TOKEN[who]

    stage.clear()
    await until(lambda: not shown(), seconds=SECONDS)


async def test_each_member_gets_answers_only_where_it_may_query(stage: Stage) -> None:
    def answer(query: zenoh.Query) -> None:
        with query:
            query.reply(query.key_expr, b"")

    for selector in ALL_TOKENS:
        stage.keep(stage.witness.declare_queryable(selector, answer))
    questions = {who: list(KEYS[who].items()) for who in WHO}

    answered = defaultdict[str, set[str]](set)

    def ask() -> bool:
        for who, keys in ask_all(questions, stage.sessions, seconds=REFUSED).items():
            answered[who] |= named(who, keys)
        return all(GET[who] <= answered[who] for who in WHO)

    await until(ask, seconds=SECONDS)
    assert {who: answered[who] for who in WHO} == GET


async def test_each_member_receives_what_it_may_read(stage: Stage) -> None:
    heard = defaultdict[str, set[str]](set)
    for who in WHO:
        for key in KEYS[who].values():

            def hear(sample: zenoh.Sample, who: str = who) -> None:
                heard[who].add(str(sample.key_expr))

            stage.keep(stage.sessions[who].declare_subscriber(key, hear))
    stage.are_past()

    def all_heard() -> bool:
        for key in {key for who in WHO for key in KEYS[who].values()}:
            stage.witness.put(key, b"", congestion_control=zenoh.CongestionControl.BLOCK)
        return all(SUBSCRIBE[who] <= named(who, heard[who]) for who in WHO)

    await until(all_heard, seconds=SECONDS, pause=0.1)
    stage.are_past()
    assert {who: named(who, heard[who]) for who in WHO} == SUBSCRIBE


async def test_each_member_sees_presence_where_it_may(stage: Stage) -> None:
    for key in {key for who in WHO for key in KEYS[who].values()}:
        stage.keep(stage.witness.liveliness().declare_token(key))
    stage.are_past()
    seen = defaultdict[str, set[str]](set)

    def look(who: str) -> None:
        liveliness = stage.sessions[who].liveliness()
        asked = {key: liveliness.get(key, timeout=REFUSED) for key in KEYS[who].values()}
        found = {key for key, replies in asked.items() if any(reply.ok is not None for reply in replies)}
        seen[who] |= named(who, found)

    def all_look() -> bool:
        threads = [threading.Thread(target=look, args=(who,)) for who in WHO]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        return all(PRESENCE[who] <= seen[who] for who in WHO)

    await until(all_look, seconds=SECONDS)
    assert {who: seen[who] for who in WHO} == PRESENCE


WILD = ("aira/**", "aira/agent/**", "aira/agent/*/rpc/**", "aira/*/demand/*", "aira/*/@agent/*/*", "aira/*/**")
OTHERS_KEY = KEYS["arm"]["other rpc"]


async def test_a_wildcard_write_reaches_only_permitted_keys(stage: Stage) -> None:
    published, answered = set[str](), set[str]()
    for selector in ALL_TOKENS:
        stage.keep(stage.witness.declare_subscriber(selector, lambda sample: published.add(str(sample.key_expr))))
    await until_heard(stage.sessions["arm"], KEYS["arm"]["demand"])
    for who in WHO:
        for key in WILD:

            def answer(query: zenoh.Query, who: str = who) -> None:
                answered.update({who} if str(query.key_expr) == OTHERS_KEY else ())  # it hears itself, too
                query.drop()  # type: ignore[no-untyped-call]

            stage.sessions[who].put(key, b"", congestion_control=zenoh.CongestionControl.BLOCK)
            stage.sessions[who].delete(key, congestion_control=zenoh.CongestionControl.BLOCK)
            stage.keep(stage.sessions[who].declare_queryable(key, answer))
            stage.keep(stage.sessions[who].liveliness().declare_token(key))
    stage.are_past()

    assert not list(stage.witness.get(OTHERS_KEY, timeout=SECONDS, target=zenoh.QueryTarget.ALL))
    tokens = [reply for selector in ALL_TOKENS for reply in stage.witness.liveliness().get(selector, timeout=SECONDS)]
    assert (published, answered, tokens) == (set(), set(), [])


async def test_a_wildcard_read_reaches_only_permitted_keys(stage: Stage) -> None:
    heard, answered = set[str](), set[str]()
    for selector in ALL_TOKENS:
        stage.keep(stage.witness.declare_queryable(selector, lambda query: query.reply(OTHERS_KEY, b"")))
    for who in WHO:
        for key in WILD:

            def hear(sample: zenoh.Sample, who: str = who) -> None:
                heard.add(who)

            stage.keep(stage.sessions[who].declare_subscriber(key, hear))
    stage.are_past()
    questions = {who: [("", key) for key in WILD] for who in WHO}

    def all_tried() -> bool:
        for who, selectors in ask_all(questions, stage.sessions, seconds=REFUSED).items():
            answered.update({who} if selectors else ())
        stage.witness.put(OTHERS_KEY, b"", congestion_control=zenoh.CongestionControl.BLOCK)
        return "boss" in answered and heard >= {"boss", "screen"}

    await until(all_tried, seconds=SECONDS, pause=0.1)
    stage.are_past()
    assert (heard, answered) == ({"boss", "screen"}, {"boss"})
