"""An outage is logged when it begins and when it ends."""

from __future__ import annotations

import logging

import pytest

from mesh.base.outage_log import OutageLog
from mesh.chain import NodeUnreachable, Reverted


@pytest.fixture
def outages(caplog: pytest.LogCaptureFixture) -> OutageLog:
    caplog.set_level(logging.INFO)
    return OutageLog(logging.getLogger("test of outages"), "chain")


def logged(caplog: pytest.LogCaptureFixture) -> list[tuple[str, str]]:
    """Event and code of each line."""
    return [(vars(record)["event"], vars(record)["facts"].get("code", "")) for record in caplog.records]


def test_an_outage_is_logged_once_with_its_hint(outages: OutageLog, caplog: pytest.LogCaptureFixture) -> None:
    for seconds in range(3):
        outages.failed(NodeUnreachable("http://a:1", f"no answer in {seconds} s"), "nothing is read")

    assert logged(caplog) == [("chain-outage", "node-unreachable")]
    assert "http://a:1" in caplog.messages[0]


def test_another_error_is_another_outage(outages: OutageLog, caplog: pytest.LogCaptureFixture) -> None:
    for reason in ("NotYourTurn", "Paused", "NotYourTurn"):
        outages.failed(Reverted(reason), "it waits")

    assert logged(caplog) == [("chain-outage", "reverted")] * 2


def test_it_is_down_until_it_has_recovered(outages: OutageLog) -> None:
    down = [outages.is_down]
    outages.failed(Reverted("Paused"), "it waits")
    down.append(outages.is_down)
    outages.recovered("it goes on")
    down.append(outages.is_down)

    assert down == [False, True, False]


def test_the_end_of_an_outage_is_logged_once_and_a_later_outage_is_new(
    outages: OutageLog, caplog: pytest.LogCaptureFixture
) -> None:
    outages.recovered("it goes on")
    outages.failed(Reverted("Paused"), "it waits")
    outages.recovered("it goes on")
    outages.recovered("it goes on")
    outages.failed(Reverted("Paused"), "it waits")

    assert [event for event, _ in logged(caplog)] == ["chain-outage", "chain-recovered", "chain-outage"]
