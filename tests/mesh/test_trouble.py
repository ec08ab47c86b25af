"""A trouble is said when it begins and when it is over."""

from __future__ import annotations

import logging

import pytest

from mesh.chain import NodeUnreachable, Reverted
from mesh.trouble import Trouble


@pytest.fixture
def trouble(caplog: pytest.LogCaptureFixture) -> Trouble:
    caplog.set_level(logging.INFO)
    return Trouble(logging.getLogger("test of trouble"))


def test_a_standing_trouble_is_said_once_with_what_to_do(trouble: Trouble, caplog: pytest.LogCaptureFixture) -> None:
    for seconds in range(3):
        trouble.met(NodeUnreachable("http://a:1", f"no answer in {seconds} s"), "nothing is read")

    (line,) = caplog.messages
    assert line.startswith("nothing is read: no Ethereum node answers at http://a:1 (no answer in 0 s); start a node")


def test_another_trouble_is_another_line(trouble: Trouble, caplog: pytest.LogCaptureFixture) -> None:
    for reason in ("NotYourTurn", "Paused", "NotYourTurn"):
        trouble.met(Reverted(reason), "it waits")

    assert caplog.messages == [f"it waits: the contract refused: {reason}" for reason in ("NotYourTurn", "Paused")]


def test_it_stands_until_it_is_over(trouble: Trouble) -> None:
    stands = [trouble.stands]
    trouble.met(Reverted("Paused"), "it waits")
    stands.append(trouble.stands)
    trouble.over("it goes on")
    stands.append(trouble.stands)

    assert stands == [False, True, False]


def test_its_end_is_said_once_and_then_it_may_come_again(trouble: Trouble, caplog: pytest.LogCaptureFixture) -> None:
    trouble.over("it goes on")
    trouble.met(Reverted("Paused"), "it waits")
    trouble.over("it goes on")
    trouble.over("it goes on")
    trouble.met(Reverted("Paused"), "it waits")

    assert caplog.messages == [
        "it waits: the contract refused: Paused",
        "it goes on",
        "it waits: the contract refused: Paused",
    ]
