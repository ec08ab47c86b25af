"""Events of the log: their fields, and that each is one line even with hostile text."""

from __future__ import annotations

import asyncio
import json
import logging
import threading
from contextvars import copy_context
from typing import Any

import pytest

from mesh.base.log_context import LogSource, liability_context, log_event, source_context, with_liability_context
from mesh.telemetry.logs import LOG_EVENT_LIMITS, event_of, human_line, json_line, without_secrets
from schemas.status import LogEvent
from tests.support.orders import LIGHTHOUSE, ROBOT, STRANGER

LIABILITY = "0x8A7B7Bf07722e6c80579326C4F162692ccD71F39"
ARM = LogSource("agent", ROBOT.address, "market.eth")
HOSTILE = "so\n12:00:00 INFO    all is well\r\x1b[2J\x9b31m\x85\u2028\u202e\x7f{\x00}"


def record(message: str, *arguments: object, level: int = logging.INFO, error: BaseException | None = None) -> Any:
    info = None if error is None else (type(error), error, error.__traceback__)
    return logging.LogRecord("mesh.agent.jobs", level, __file__, 1, message, arguments, info)


def failed(words: str) -> ZeroDivisionError:
    """An error that was raised."""
    try:
        raise ZeroDivisionError(words)
    except ZeroDivisionError as error:
        return error


def test_an_event_has_its_source_and_its_liability() -> None:
    with source_context(ARM), liability_context(LIABILITY.lower()):
        event = event_of(record("ready, %d messages to play", 3))
    fields = json.loads(json_line(event))
    assert fields.pop("time").endswith("Z")
    assert fields == {
        "level": "info",
        "logger": "mesh.agent.jobs",
        "message": "ready, 3 messages to play",
        "role": "agent",
        "address": ROBOT.address,
        "lighthouse": "market.eth",
        "liability": LIABILITY,
    }


def test_an_event_outside_of_a_context_has_the_liability_that_its_facts_name() -> None:
    event = record("it names this validator")
    vars(event).update(log_event("case-opened", liability=LIABILITY))
    assert json.loads(json_line(event_of(event)))["liability"] == LIABILITY


def test_the_time_is_utc_with_milliseconds() -> None:
    event = record("now")
    event.created = 1_700_000_000.0019
    assert event_of(event).time == "2023-11-14T22:13:20.001Z"


def test_a_human_line_begins_with_the_liability() -> None:
    with liability_context(LIABILITY):
        line = human_line(event_of(record("finalized, paid", level=logging.WARNING)))
    assert line[8:] == f" WARNING {LIABILITY}: finalized, paid"
    assert human_line(event_of(record("started")))[8:] == " INFO    started"


def test_events_without_a_context_have_the_default_source() -> None:
    assert event_of(record("x"), default=ARM).address == ROBOT.address
    with source_context(LogSource("provider", STRANGER.address)):
        assert event_of(record("x"), default=ARM).role == "provider"


def test_facts_are_members_of_the_json_object_and_never_replace_a_field() -> None:
    event = record("rejected")
    vars(event).update(log_event("order-rejected", order="ab" * 32, gas=7, level="none", message="forged"))
    fields = json.loads(json_line(event_of(event)))
    assert (fields["event"], fields["order"], fields["gas"]) == ("order-rejected", "ab" * 32, "7")
    assert (fields["level"], fields["message"]) == ("info", "rejected")


def test_a_fact_named_like_a_field_without_a_value_is_in_the_json_object() -> None:
    event = record("not answered")
    vars(event).update(log_event("content-serve-failed", error="the disk is full", lighthouse=LIGHTHOUSE, trace=""))
    fields = json.loads(json_line(event_of(event)))
    assert (fields["error"], fields["lighthouse"]) == ("the disk is full", LIGHTHOUSE)
    assert "trace" not in fields


@pytest.mark.parametrize("write", [human_line, json_line])
def test_untrusted_text_stays_on_one_line_and_can_not_control_the_terminal(write: Any) -> None:
    line = write(event_of(record("%s of %s", HOSTILE, "him")))
    assert line.isprintable(), ascii(line)
    assert len(line.splitlines()) == 1


def test_json_lines_keep_untrusted_text_unchanged() -> None:
    assert json.loads(json_line(event_of(record("%s", HOSTILE))))["message"] == HOSTILE


def test_an_exception_is_part_of_the_json_line() -> None:
    line = json_line(event_of(record("the job failed", error=failed("by\nnothing"))))
    fields = json.loads(line)
    assert len(line.splitlines()) == 1
    assert fields["error"] == "ZeroDivisionError: by\nnothing"
    assert fields["trace"].startswith("Traceback (most recent call last):\n")
    assert "in failed\n" in fields["trace"]


def test_a_line_of_a_traceback_can_not_pass_for_an_event() -> None:
    _, *rest = human_line(event_of(record("failed", error=failed(HOSTILE)))).split("\n")
    assert len(rest) > 3
    for line in rest:
        assert line.startswith("    | ")
        assert line.isprintable()


def test_an_event_fits_into_a_reply_however_long_its_words_are() -> None:
    event = event_of(record("x" * 100_000, error=failed("\x00" * 100_000)))
    assert event.message.startswith("x" * 1_000)
    assert event.message.endswith("characters more)")
    assert len(event.encode()) <= LOG_EVENT_LIMITS.size
    assert event_of(record("x" * 5_000)).message == "x" * LOG_EVENT_LIMITS.message + "… (1,000 characters more)"


def test_undecodable_file_names_can_be_logged() -> None:
    event = event_of(record("can't read %s", b"\xff.mcap".decode("utf-8", "surrogateescape")))
    assert event.message == "can't read \\udcff.mcap"
    assert LogEvent.decode(event.encode()) == event


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("wss://user:pass@node.example:8546/x fails", "wss://node.example:8546/x fails"),
        ("(https://node.example/v3/0123456789abcdef0123) fails", "(https://node.example/v3/… fails"),
        ("https://node.example/?apikey=abc, then", "https://node.example/?… then"),
        ("http://127.0.0.1:8545 and tcp/127.0.0.1:7447", "http://127.0.0.1:8545 and tcp/127.0.0.1:7447"),
        (f"http://gateway/ipfs/Qm{'a' * 44}", f"http://gateway/ipfs/Qm{'a' * 44}"),
    ],
)
def test_secrets_in_urls_are_removed(text: str, expected: str) -> None:
    assert without_secrets(text).replace(")", "") == expected
    event = event_of(record("%s", text, error=failed(text)))
    for secret in ("pass@", "0123456789abcdef", "apikey"):
        assert secret not in event.message + event.error + event.trace.replace(repr(text), "")


def test_a_level_between_two_is_mapped_to_the_lower() -> None:
    named = {level: event_of(record("x", level=level)).level for level in (0, 5, 10, 20, 25, 30, 40, 50, 99)}
    assert list(named.values()) == [
        "debug", "debug", "debug", "info", "info", "warning", "error", "critical", "critical",
    ]  # fmt: skip


def test_the_name_of_an_event_is_in_json_lines_and_not_in_human_lines() -> None:
    named = record("created, gas 7")
    vars(named).update(log_event("contract-created", gas=7))
    event = event_of(named)
    assert event.event == "contract-created"
    assert json.loads(json_line(event))["event"] == "contract-created"
    assert human_line(event)[8:] == " INFO    created, gas 7"
    assert "event" not in json.loads(json_line(event_of(record("a library's message"))))


async def test_tasks_and_threads_inherit_the_liability() -> None:
    seen: dict[str, str] = {}

    class Work:
        @with_liability_context
        async def do(self, address: str, *, name: str) -> None:
            await asyncio.sleep(0.01)
            seen[name] = event_of(record("x")).liability
            seen[f"{name}'s thread"] = await asyncio.to_thread(lambda: event_of(record("x")).liability)
            bare = threading.Thread(target=copy_context().run, args=(self.note, f"{name}'s own thread"))
            bare.start()
            bare.join()

        def note(self, name: str) -> None:
            seen[name] = event_of(record("x")).liability

    await asyncio.gather(Work().do(ROBOT.address, name="one"), Work().do(STRANGER.address, name="other"))
    assert {seen["one"], seen["one's thread"], seen["one's own thread"]} == {ROBOT.address}
    assert {seen["other"], seen["other's thread"], seen["other's own thread"]} == {STRANGER.address}
    assert event_of(record("x")).liability == ""


def test_a_malformed_time_is_shown_as_dashes() -> None:
    event = LogEvent(time="\x1b[31m", level="info", logger="x", message="hello")
    assert human_line(event) == "--:--:-- INFO    hello"
