"""The lines and JSON objects that `aira watch` prints for what happens on a market."""

from __future__ import annotations

from typing import Any

import msgspec

from mesh.amounts import XRT
from mesh.cli.watch import EventFormatter, event_json, format_counters
from mesh.network import Reading
from mesh.watching import JobEvent, MarketCounters, PresenceChange, PresentPeer
from schemas import String, verify_message
from schemas.payloads import encode_value
from schemas.signing import Decline, Rejection
from tests.mesh.watching.test_market import JOB
from tests.support.jurors import MISSING, Juror
from tests.support.orders import CONTRACT, MARKET, PERSON, RECORDING, ROBOT, TOKEN, demand, liability, offer, result

NOON = "2026-01-01T12:00:00.000Z"


def format_line(message: Any) -> str:
    return EventFormatter({TOKEN: XRT}).line(message)


def test_an_order_is_printed_as_a_line() -> None:
    order = verify_message(demand(cost=1_500_000_000, deadline=12_345))
    line = format_line(order)
    assert line.startswith(f"demand     {order.hash.hex()[:8]}  {order.signer} pays 1.5 XRT, model Qm")
    assert line.endswith(", until block 12,345")
    assert "works for 1.5 XRT and 2 XRT to the provider, model" in format_line(
        verify_message(offer(cost=1_500_000_000, lighthouse_fee=2 * 10**9))
    )


def test_an_amount_of_an_unknown_token_is_printed_in_its_smallest_units() -> None:
    line = EventFormatter({}).line(verify_message(demand(cost=1500)))
    assert f"pays 1,500 units of {TOKEN[:6]}…{TOKEN[-4:]}, " in line


def test_the_line_of_a_result_has_the_full_cid() -> None:
    line = format_line(verify_message(result(liability=CONTRACT, success=False)))
    signer = f"{ROBOT.address[:6]}…{ROBOT.address[-4:]}"
    assert line == f"result     {RECORDING}  not done, for {CONTRACT}, signed by {signer}"


def test_the_line_of_a_job_has_the_full_address_of_its_contract() -> None:
    ended = msgspec.structs.replace(JOB, result=RECORDING, is_success=True)
    assert format_line(JobEvent(ROBOT.address, "incoming", JOB)).startswith(
        f"incoming   {CONTRACT}  {ROBOT.address[:6]}…"
    )
    assert format_line(JobEvent(ROBOT.address, "complete", ended)).endswith(f", done: {RECORDING}")


def test_the_line_of_a_rejection_is_short_and_has_no_control_characters() -> None:
    rejection = Rejection(order="ab" * 32, reason="x", detail="\x1b[2J" + "y" * 500, provider=ROBOT.address)
    line = format_line(rejection)
    assert line.startswith("rejected   abababab by 0x")
    assert "\x1b" not in line
    assert len(line) < 300


def test_a_rejection_is_printed_as_json() -> None:
    rejection = Rejection(order="ab" * 32, reason="expired", detail="too late", provider=ROBOT.address)
    assert event_json(rejection, time=NOON) == {
        "time": NOON,
        "event": "rejected",
        "order": "ab" * 32,
        "provider": ROBOT.address,
        "reason": "expired",
        "detail": "too late",
    }


def test_a_decline_is_printed_as_a_line_and_as_json() -> None:
    decline = Decline(order="ab" * 32, code="too-cheap", detail="\x1b[2Jat least 5 XRT", agent=ROBOT.address)
    assert format_line(decline).startswith("declined   abababab by 0x")
    assert format_line(decline).endswith("at least 5 XRT (too-cheap)")
    assert "\x1b" not in format_line(decline)
    assert event_json(decline, time=NOON) == {
        "time": NOON,
        "event": "declined",
        "order": "ab" * 32,
        "agent": ROBOT.address,
        "code": "too-cheap",
        "detail": "\x1b[2Jat least 5 XRT",
    }


def test_a_report_is_printed_as_a_line_and_as_json() -> None:
    juror = Juror(endpoint="", lighthouse=MARKET, signer=ROBOT, validator=PERSON.address)
    report = juror.report(liability(), RECORDING, success=False)
    line = format_line(report)
    assert line.startswith(f"judged     {report.liability} by juror 0x")
    assert line.endswith(f": the work does not count: {MISSING.detail} ({MISSING.code})")
    printed = event_json(report, time=NOON)
    assert (printed["event"], printed["success"], printed["findings"][0]["code"]) == ("judged", False, MISSING.code)


def test_counters_are_printed_as_a_sentence() -> None:
    counters = MarketCounters(received=1_234, refused={"signature": 2, "event": 1}, duplicate=3, lost=0)
    assert format_counters(counters) == "1,234 messages received, 3 duplicate, 3 invalid (1 event, 2 signature)"
    assert format_counters(msgspec.structs.replace(counters, lost=9)).endswith(
        "), 9 lost because this reader was too slow"
    )


def read(value: Any, *, result: str = "") -> Reading:
    payload, kind = encode_value(value)
    return Reading(ROBOT.address, "/air", value, payload, kind, result)


def test_a_reading_is_printed_as_json_with_the_result_in_which_it_came() -> None:
    facts = {"time": NOON, "event": "reading", "agent": ROBOT.address, "topic": "/air", "value": 4.5}
    assert event_json(read(4.5), time=NOON) == facts
    in_result = facts | {"signer": ROBOT.address, "result": RECORDING}
    assert event_json(read(4.5, result=RECORDING), time=NOON) == in_result


def test_the_line_of_a_reading_is_short_and_has_no_control_characters() -> None:
    line = format_line(read(String("\x1b[2J" + "y" * 500)))
    assert line.startswith("reading    /air  ")
    assert "\x1b" not in line
    assert len(line) < 300
    assert format_line(read({"CO": 1})).startswith('reading    /air  {"CO":1}, from 0x')
    assert format_line(read(None)).startswith("reading    /air  null, from 0x")
    assert format_line(read(b"ab")).startswith('reading    /air  "YWI=", from 0x')


def test_a_validator_that_comes_or_goes_is_an_event() -> None:
    peer = PresentPeer("validator", ROBOT.address)
    facts = {"time": NOON, "role": "validator", "agent": ROBOT.address}
    assert event_json(PresenceChange(peer, True), time=NOON) == facts | {"event": "present"}
    assert event_json(PresenceChange(peer, False), time=NOON) == facts | {"event": "gone"}
