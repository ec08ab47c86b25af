"""Who carries what, decided without any network."""

from __future__ import annotations

from itertools import count
from typing import Any

import pytest

from bridges.ipfs.gate import Passenger
from bridges.ipfs.memory import LASTS, REMEMBERED, Memory, Side
from bridges.ipfs.outbox import RESCUE, Waiting
from bridges.ipfs.traffic import Fate, Traffic
from bridges.ipfs.turns import Turn, first_before, turn_of
from schemas import InvalidKey

ONE, TWO = f"0x{'1' * 40}", f"0x{'2' * 40}"
SENIOR, JUNIOR = Turn(False, 1, ONE), Turn(False, 2, TWO)
LIGHTHOUSE = "airalab.lighthouse.3.robonomics.eth"
_numbers = count()


class Time:
    now = 1000.0

    def __call__(self) -> float:
        return self.now


class Notes:
    def __init__(self) -> None:
        self.waiting: set[bytes] = set()
        self.both: list[bytes] = []

    def wait(self, to: Side, waiting: Waiting) -> None:
        self.waiting.add(waiting.passenger.fingerprint)

    def crossed(self, fingerprint: bytes) -> None:
        self.waiting.discard(fingerprint)
        self.both.append(fingerprint)

    def given_up(self, fingerprint: bytes) -> None:
        self.waiting.discard(fingerprint)


@pytest.fixture
def time() -> Time:
    return Time()


@pytest.fixture
def notes() -> Notes:
    return Notes()


def bridge(time: Time, notes: Notes, own: Turn | None = None, *others: Turn, **options: Any) -> Traffic:
    traffic = Traffic(time, notes, **options)
    for other in others:
        traffic.joined(other)
    traffic.take_turn(own)
    return traffic


def message() -> Passenger:
    return Passenger(next(_numbers).to_bytes(16, "big"), "aira/market/demand/model/hash", b"payload", b"legacy")


def carry(traffic: Traffic, side: Side, *, heard: bool = True) -> list[bytes]:
    """Carry all that is this bridge's to carry."""
    carried = []
    while (waiting := traffic.to[side].next()) is not None:
        traffic.carried(waiting, side, heard=heard)
        carried.append(waiting.passenger.fingerprint)
    return carried


@pytest.mark.parametrize("side", Side)
def test_a_message_crosses_once_and_its_echo_does_not_come_back(time: Time, notes: Notes, side: Side) -> None:
    traffic, one = bridge(time, notes, SENIOR), message()
    assert traffic.seen(one, side) is Fate.ACCEPTED
    assert traffic.seen(one, side) is Fate.KNOWN
    assert notes.waiting == {one.fingerprint}
    assert carry(traffic, side.other) == [one.fingerprint]
    assert traffic.seen(one, side.other) is Fate.KNOWN
    assert traffic.seen(one, side) is Fate.KNOWN
    assert (notes.waiting, notes.both) == (set(), [one.fingerprint])
    assert carry(traffic, side) == carry(traffic, side.other) == []


def test_an_echo_that_is_faster_than_the_daemons_answer_does_not_carry_it_again(time: Time, notes: Notes) -> None:
    traffic, one = bridge(time, notes, SENIOR), message()
    traffic.seen(one, Side.MESH)
    assert traffic.to[Side.IPFS].next() is not None
    assert traffic.seen(one, Side.IPFS, echo=True) is Fate.KNOWN
    assert carry(traffic, Side.IPFS) == []


def test_what_is_sent_again_after_ten_minutes_crosses_again(time: Time, notes: Notes) -> None:
    traffic, one = bridge(time, notes, SENIOR), message()
    traffic.seen(one, Side.MESH)
    carry(traffic, Side.IPFS)
    time.now += LASTS - 1
    assert traffic.seen(one, Side.MESH) is Fate.KNOWN
    time.now += 2
    assert traffic.seen(one, Side.MESH) is Fate.ACCEPTED


def test_what_another_bridge_has_put_is_not_brought_back(time: Time, notes: Notes) -> None:
    traffic, one = bridge(time, notes, SENIOR), message()
    assert traffic.seen(one, Side.MESH, by_bridge=True) is Fate.KNOWN
    assert carry(traffic, Side.IPFS) == []
    # Nor does the mark keep anybody's own message from crossing.
    assert traffic.seen(one, Side.MESH) is Fate.ACCEPTED


def test_the_bridge_that_was_there_first_carries_and_the_other_sees_it_arrive(time: Time, notes: Notes) -> None:
    first, second = bridge(time, notes, SENIOR, JUNIOR), bridge(time, notes, JUNIOR, SENIOR)
    one = message()
    for traffic in (first, second):
        traffic.seen(one, Side.MESH)
    assert carry(second, Side.IPFS) == []
    assert carry(first, Side.IPFS) == [one.fingerprint]
    second.seen(one, Side.IPFS)
    second.gone(SENIOR)
    assert carry(second, Side.IPFS) == []
    assert second.way(Side.IPFS, per_second=0).left == 1


def test_what_was_left_to_a_bridge_that_ends_is_carried_by_the_next(time: Time, notes: Notes) -> None:
    traffic, one = bridge(time, notes, JUNIOR, SENIOR), message()
    traffic.seen(one, Side.MESH)
    traffic.gone(SENIOR)
    assert carry(traffic, Side.IPFS) == [one.fingerprint]


def test_what_was_left_and_does_not_arrive_is_taken_back(time: Time, notes: Notes) -> None:
    traffic, one, two, late = bridge(time, notes, JUNIOR, SENIOR), message(), message(), message()
    traffic.seen(one, Side.MESH)
    traffic.seen(two, Side.MESH)
    time.now += RESCUE - 1
    traffic.seen(two, Side.IPFS)  # the other one is at it
    time.now += 2
    assert traffic.look_after_left() == 0
    time.now += RESCUE - 3
    traffic.seen(late, Side.MESH)
    time.now += 2
    assert traffic.look_after_left() == 1
    assert carry(traffic, Side.IPFS) == [one.fingerprint]


def test_who_loses_the_daemon_hands_over_what_the_other_has_too_and_does_not_say_it_again(
    time: Time, notes: Notes
) -> None:
    traffic = bridge(time, notes, SENIOR)
    alone, shared = message(), message()
    traffic.seen(alone, Side.MESH)
    traffic.joined(JUNIOR)
    traffic.seen(shared, Side.MESH)
    traffic.take_turn(None)
    traffic.take_turn(Turn(False, 3, ONE))
    assert carry(traffic, Side.IPFS) == [alone.fingerprint]
    assert notes.waiting == set()


def test_a_bridge_whose_daemon_is_deaf_stands_behind_one_whose_is_not(time: Time, notes: Notes) -> None:
    deaf, hearing = Turn(True, 1, ONE), Turn(False, 2, TWO)
    assert first_before(deaf, [hearing]) == hearing
    assert first_before(hearing, [deaf]) is None
    assert first_before(None, [deaf]) == deaf
    assert first_before(None, []) is None
    traffic, one = bridge(time, notes, deaf, hearing), message()
    traffic.seen(one, Side.MESH)
    time.now += 2 * RESCUE
    assert traffic.look_after_left() == 0  # it could not hear it arrive
    assert carry(traffic, Side.IPFS) == []


def test_what_nobody_heard_is_said_again_before_the_rest_unless_somebody_else_said_it(time: Time, notes: Notes) -> None:
    traffic, one, two, three = bridge(time, notes, Turn(True, 1, ONE)), message(), message(), message()
    for passenger in (one, two):
        traffic.seen(passenger, Side.MESH)
    carry(traffic, Side.IPFS, heard=False)
    traffic.seen(one, Side.IPFS, echo=True)  # our own daemon's
    traffic.seen(two, Side.IPFS)  # another node's
    traffic.seen(three, Side.MESH)
    assert traffic.to[Side.IPFS].unheard == 1
    assert traffic.to[Side.IPFS].say_again() == 1
    assert carry(traffic, Side.IPFS) == [one.fingerprint, three.fingerprint]


def test_a_full_outbox_takes_nothing_and_loses_nothing(time: Time, notes: Notes) -> None:
    traffic, messages = bridge(time, notes, SENIOR, limit=2), [message() for _ in range(3)]
    assert [traffic.seen(one, Side.MESH) for one in messages] == [Fate.ACCEPTED, Fate.ACCEPTED, Fate.NO_ROOM]
    assert traffic.way(Side.IPFS, per_second=0).dropped == {"no-room": 1}
    assert carry(traffic, Side.IPFS) == [one.fingerprint for one in messages[:2]]
    assert traffic.seen(messages[2], Side.MESH) is Fate.ACCEPTED


def test_what_the_far_side_refuses_is_dropped_and_counted(time: Time, notes: Notes) -> None:
    traffic, one = bridge(time, notes, SENIOR), message()
    traffic.seen(one, Side.MESH)
    waiting = traffic.to[Side.IPFS].next()
    assert waiting is not None
    traffic.refused(waiting, Side.IPFS)
    assert traffic.way(Side.IPFS, per_second=0).dropped == {"refused": 1}
    assert notes.waiting == set()


def test_what_waited_when_a_bridge_ended_is_left_to_the_one_that_had_it_too(time: Time, notes: Notes) -> None:
    traffic = bridge(time, notes, JUNIOR, SENIOR)
    assert not traffic.restore(Waiting(message(), True, None, 0.0), Side.IPFS)
    assert traffic.restore(Waiting(own := message(), False, None, 0.0), Side.IPFS)
    traffic.gone(SENIOR)
    assert carry(traffic, Side.IPFS) == [own.fingerprint]


def test_the_memory_is_bounded(time: Time) -> None:
    memory = Memory(time)
    for number in range(REMEMBERED + 1):
        memory.note(number.to_bytes(16, "big"), Side.MESH)
    assert len(memory) == REMEMBERED
    assert not memory.knows((0).to_bytes(16, "big"), Side.MESH)


@pytest.mark.parametrize("turn", [SENIOR, Turn(True, 2**63, TWO)])
def test_a_turn_is_read_as_it_was_shown(turn: Turn) -> None:
    assert turn_of(turn.key(LIGHTHOUSE)) == turn


@pytest.mark.parametrize("role", ["bridge", "provider", "bridge-turn-2-0000000000000001", "bridge-turn-0-1"])
def test_other_tokens_are_no_turns(role: str) -> None:
    assert turn_of(f"aira/{LIGHTHOUSE}/@agent/{role}/{ONE}") is None
    assert turn_of("anything") is None
    with pytest.raises(InvalidKey):
        Turn(False, 1, "*").key(LIGHTHOUSE)
